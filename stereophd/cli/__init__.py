"""The command line: each command parses its options, calls one function, and prints."""

import sys

if sys.argv[:1] == ["-m"]:  # run as `python -m stereophd.cli.app`, and nothing slow is imported yet
    from stereophd.cli import early

    early.handle()
