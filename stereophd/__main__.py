"""``python -m stereophd``: the command line."""

from __future__ import annotations

from stereophd.cli.app import main

main()
