"""Where the tests find the shared data sets, which are no part of the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def shared_data(*parts: str) -> Path:
    """Return a folder of the shared data; skips the test, saying so, where there is none."""
    root = Path(os.environ.get("STEREOPHD_DATA") or Path(__file__).parents[2] / "shared" / "data")
    folder = root.joinpath(*parts)
    if not folder.is_dir():
        pytest.skip(f"no shared data ({'/'.join(parts)}): set STEREOPHD_DATA to their folder")
    return folder
