"""Compiled kernels of sources that have changed since are not used."""

from __future__ import annotations

import os
from pathlib import Path

from stereophd.core.numerics.compilation import drop_outdated


def test_compiled_kernels_go_when_any_source_changes(tmp_path: Path) -> None:
    source = tmp_path / "inner" / "kernels.py"
    kept = tmp_path / "inner" / "__pycache__"
    kept.mkdir(parents=True)
    source.write_text("a = 1\n")
    assert drop_outdated(tmp_path)
    index, code, bytecode = kept / "kernels.f-1.py311.nbi", kept / "kernels.f-1.py311.1.nbc", kept / "kernels.pyc"
    for path in (index, code, bytecode):
        path.write_text("compiled")
    assert not drop_outdated(tmp_path)
    assert index.exists()
    os.utime(source, (1, 1))
    assert drop_outdated(tmp_path)
    assert not index.exists()
    assert not code.exists()
    assert bytecode.exists()
    assert not drop_outdated(tmp_path)
