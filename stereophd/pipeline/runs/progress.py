"""How the work of every command reports its progress."""

from collections.abc import Callable

# Called with (done, total): rows of a log, frames, runs, starts. An exception that it raises ends the work.
Progress = Callable[[int, int], None]


def ignore(done: int, total: int) -> None:
    """Show nothing."""
