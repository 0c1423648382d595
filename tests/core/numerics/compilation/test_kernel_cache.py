"""Kept kernels: valid only for the sources they were compiled from; damaged ones are compiled anew."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

from stereophd.core.numerics.compilation import kernel_cache, kernel_units
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.linear_algebra import cholesky


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(kernel_units, "PACKAGE_PARENT", tmp_path)
    folder = tmp_path / "stereophd"
    folder.mkdir()
    (folder / "a.py").write_text("from stereophd.b import f\n")
    (folder / "b.py").write_text("from stereophd import c\n")
    (folder / "c.py").write_text("x = 1\n")
    (folder / "d.py").write_text("x = 1\n")
    return folder


def _digest(file: Path) -> str:
    kernel_units._read_source.cache_clear()
    kernel_units.source_digest.cache_clear()
    return kernel_units.source_digest(file)


@pytest.mark.parametrize(("changed", "stays"), [("a.py", False), ("b.py", False), ("c.py", False), ("d.py", True)])
def test_digest_follows_the_imports(package: Path, changed: str, stays: bool) -> None:
    before = _digest(package / "a.py")
    (package / changed).write_text((package / changed).read_text() + "y = 2\n")
    assert (_digest(package / "a.py") == before) is stays


def _run() -> list[int]:
    """Compile or load a kernel as a new process would; return how often it found a kept one, and how often none."""
    for function in (kernel_cache.kernel_folders, kernel_cache._note_nothing_kept, kernel_cache._prune):
        function.cache_clear()
    kernel_cache._FAILED.clear()
    kernel = compiled(cholesky.py_func)  # type: ignore[attr-defined]
    factor = np.zeros((2, 2))
    assert kernel(4.0 * np.eye(2), factor)
    assert factor[0, 0] == 2.0
    stats = kernel.for_python.stats  # type: ignore[attr-defined]
    return [sum(stats.cache_hits.values()), sum(stats.cache_misses.values())]


@pytest.fixture
def folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[list[Path]]:
    """The folders in which kernels are looked for; the last resort lies in ``tmp``."""
    found: list[Path] = []
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    *_, last = kernel_cache._candidates()
    monkeypatch.setattr(kernel_cache, "_candidates", lambda: [*found, last])
    kernel_cache.kernel_folders.cache_clear()
    yield found
    kernel_cache.kernel_folders.cache_clear()
    kernel_cache._FAILED.clear()


@pytest.fixture
def full(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Folders that take no files: read-only, or on a full disk."""
    found: list[Path] = []
    save = IndexDataCacheFile.save

    def fails(self: IndexDataCacheFile, key: object, data: object) -> None:
        if any(str(folder) in self._cache_path for folder in found):
            raise OSError(errno.ENOSPC, "No space left on device")
        save(self, key, data)

    monkeypatch.setattr(IndexDataCacheFile, "save", fails)
    return found


def test_a_kept_kernel_that_makes_arrays_may_be_the_first_of_a_process() -> None:
    """A process compiles it, or loads it from the tests' cache; the next one loads it before anything else."""
    words = (
        "from stereophd.core.geometry.lens import Lens; print(Lens('radial', k1=-0.1).distort([[0.5, 0.0]])[0][0, 0])"
    )
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout.strip()) == (0, "0.4875"), done.stderr


@pytest.mark.parametrize(("suffix", "content"), [("nbi", b""), ("nbc", b"rubbish")])
def test_damaged_kernels_are_compiled_anew(folders: list[Path], tmp_path: Path, suffix: str, content: bytes) -> None:
    folders.append(tmp_path / "kept")
    assert _run() == [0, 1]
    assert _run() == [1, 0]
    for path in tmp_path.rglob(f"*.{suffix}"):
        path.write_bytes(content)
    assert _run() == [0, 1]
    assert _run() == [1, 0]


def test_that_a_kernel_must_be_compiled_is_said_once(
    folders: list[Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folders.append(tmp_path / "kept")
    caplog.set_level("INFO", "stereophd.progress")
    for told in (1, 0):  # compiled, then kept
        kernel_cache.note_compilation.cache_clear()
        caplog.clear()
        _run()
        _run()
        assert caplog.messages == ["compiling kernels: once, up to a minute"] * told


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="the system has no owners of files")
def test_a_folder_is_looked_at_each_time_that_a_kernel_is_loaded(folders: list[Path], tmp_path: Path) -> None:
    folders.append(tmp_path / "kept")
    assert _run() == [0, 1]
    assert _run() == [1, 0]
    (tmp_path / "kept").chmod(0o777)  # after the first look
    assert _run() == [0, 1]


def test_kernels_of_a_read_only_package_are_used(folders: list[Path], full: list[Path], tmp_path: Path) -> None:
    folders += [Path(os.devnull) / "x", tmp_path / "package", tmp_path / "own"]
    assert _run() == [0, 1]
    full.append(tmp_path)
    folders[:] = [tmp_path / "own", tmp_path / "package"]
    assert _run() == [1, 0]
    assert not (tmp_path / "own").exists()


def test_a_full_disk_is_passed_over(folders: list[Path], full: list[Path], tmp_path: Path) -> None:
    full.append(tmp_path / "full")
    folders += [tmp_path / "full", tmp_path / "own"]
    assert _run() == [0, 1]
    assert _run() == [1, 0]
    assert not list((tmp_path / "full").rglob("*.nb*"))


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="the system has no owners of files")
def test_the_last_resort_is_a_folder_that_only_this_user_can_enter(
    folders: list[Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folders.append(Path(os.devnull) / "x")
    assert _run() == [0, 1]
    assert _run() == [1, 0]
    (folder,) = (tmp_path / "tmp").iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert not caplog.records
    # Kernels that somebody else may have put there are not used.
    folder.chmod(0o777)
    assert _run() == [0, 1]
    (record,) = caplog.records
    assert record.getMessage().startswith("compiled kernels cannot be kept, so every run compiles them")


def test_candidates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def found(**environment: str) -> list[str]:
        for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
            monkeypatch.delenv(name, raising=False)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        return [str(path.parent) for path in kernel_cache._candidates()]

    package, temporary = str(kernel_units.PACKAGE_PARENT / "stereophd" / "__pycache__"), tempfile.gettempdir()
    assert found() == [package, temporary]
    assert found(NUMBA_CACHE_DIR="/n", XDG_CACHE_HOME="/x", HOME="/h") == ["/n", package, "/x", temporary]
    assert found(HOME=str(tmp_path)) == [package, str(tmp_path / ".cache"), temporary]
    assert found(HOME="/no/such/home") == [package, temporary]


def test_kernels_that_nobody_used_for_a_month_are_removed(tmp_path: Path) -> None:
    digest = "0123456789abcdef0123"
    names = {f"core.a-{digest}": False, f"core.b-{digest}": True, "precious": True, f"c-{digest[:5]}": True}
    for name, stays in names.items():
        (tmp_path / name).mkdir()
        if name == "precious" or not stays:
            os.utime(tmp_path / name, (0, 0))
    kernel_cache._prune.cache_clear()
    kernel_cache._prune(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {name for name, stays in names.items() if stays}


def test_the_time_of_the_last_use_is_kept(tmp_path: Path) -> None:
    os.utime(tmp_path, (0, 0))
    kernel_cache._mark_used(tmp_path)
    assert time.time() - tmp_path.stat().st_mtime < 60


def test_a_kernel_is_known_to_be_kept_once_it_was_compiled(folders: list[Path]) -> None:
    kernel = compiled(cholesky.py_func)  # type: ignore[attr-defined]
    assert not kernel_cache.is_kept(kernel)
    assert _run() == [0, 1]
    assert kernel_cache.is_kept(kernel)
