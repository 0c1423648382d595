"""``python -m stereophd``, and the console script: signals are handled before anything slow is imported."""

import gc

from stereophd.cli import early
from stereophd.core.numerics.threads import use_one_thread

# New objects after which Python searches for garbage: more than a command imports. Its own 700 search them many times.
OBJECTS_BEFORE_SEARCH = 300_000


def main() -> None:
    """Run the command line, and exit with its code."""
    early.handle()
    use_one_thread()
    gc.set_threshold(OBJECTS_BEFORE_SEARCH)
    from stereophd.cli.app import main as run

    run()


if __name__ == "__main__":
    main()
