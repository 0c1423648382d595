"""``python -m stereophd``, and the console script: signals are handled before anything slow is imported."""

from stereophd.cli import early
from stereophd.core.numerics.threads import use_one_thread


def main() -> None:
    """Run the command line, and exit with its code."""
    early.handle()
    use_one_thread()
    from stereophd.cli.app import main as run

    run()


if __name__ == "__main__":
    main()
