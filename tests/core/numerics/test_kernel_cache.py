"""Kept kernels: valid only for the sources they were compiled from; damaged ones are compiled anew."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stereophd.core.numerics import kernel_cache

PROGRAM = """
import numpy as np
from stereophd.core.numerics.linear_algebra import cholesky
factor = np.zeros((2, 2))
assert cholesky(4.0 * np.eye(2), factor)
assert factor[0, 0] == 2.0
print(sum(cholesky.stats.cache_hits.values()), sum(cholesky.stats.cache_misses.values()))
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(kernel_cache, "_ROOT", tmp_path)
    folder = tmp_path / "stereophd"
    folder.mkdir()
    (folder / "a.py").write_text("from stereophd.b import f\n")
    (folder / "b.py").write_text("from stereophd import c\n")
    (folder / "c.py").write_text("x = 1\n")
    (folder / "d.py").write_text("x = 1\n")
    return folder


def _digest(file: Path) -> str:
    kernel_cache._imported_files.cache_clear()
    kernel_cache.source_digest.cache_clear()
    return kernel_cache.source_digest(file)


@pytest.mark.parametrize(("changed", "stays"), [("a.py", False), ("b.py", False), ("c.py", False), ("d.py", True)])
def test_digest_follows_the_imports(package: Path, changed: str, stays: bool) -> None:
    before = _digest(package / "a.py")
    (package / changed).write_text((package / changed).read_text() + "y = 2\n")
    assert (_digest(package / "a.py") == before) is stays


def _run(folder: Path) -> list[int]:
    """Run the program in a process of its own; return how often it found a kept kernel, and how often none."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "NUMBA_CACHE_DIR": str(folder)}, check=True, capture_output=True, text=True,
    )  # fmt: skip
    return [int(word) for word in done.stdout.split()]


def test_damaged_kernels_are_compiled_anew(tmp_path: Path) -> None:
    assert _run(tmp_path) == [0, 1]
    assert _run(tmp_path) == [1, 0]
    for suffix in ("nbi", "nbc"):
        for content in (b"", b"rubbish"):
            for path in tmp_path.rglob(f"*.{suffix}"):
                path.write_bytes(content)
            assert _run(tmp_path) == [0, 1]
            assert _run(tmp_path) == [1, 0]
