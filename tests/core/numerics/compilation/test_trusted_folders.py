"""Kernels are run only from folders that nobody else can write to."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest

from stereophd.core.numerics.compilation import kernel_cache, trusted_folders
from stereophd.core.numerics.compilation.trusted_folders import can_make, is_trusted, make_folder

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="the system has no owners of files")

OTHER = 54321


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "a" / "b"
    assert make_folder(path)
    assert path.stat().st_mode & 0o777 == 0o700
    (path / "kernel.nbc").write_bytes(b"code")
    return path


@pytest.mark.parametrize(
    ("place", "mode", "trusted"),
    [
        (".", 0o755, True),
        (".", 0o777, False),
        (".", 0o1777, False),
        (".", 0o775, False),
        ("..", 0o777, False),
        ("..", 0o775, False),
        ("..", 0o1777, True),
        ("kernel.nbc", 0o666, False),
        ("kernel.nbc", 0o644, True),
    ],
)
def test_nobody_else_may_write_to_a_place(
    folder: Path, monkeypatch: pytest.MonkeyPatch, place: str, mode: int, trusted: bool
) -> None:
    monkeypatch.setattr(trusted_folders, "_is_own_group", lambda number: False)
    assert is_trusted(folder)
    (folder / place).chmod(mode)
    assert is_trusted(folder) is trusted
    if place != "kernel.nbc":
        assert can_make(folder) is trusted


def test_nothing_is_made_where_others_can_write(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    assert not make_folder(tmp_path / "kernels")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("place", [".", ".."])
def test_another_owner_is_not_trusted(folder: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    lstat, wanted = os.lstat, os.path.realpath(folder / place)

    def as_if_owned(path: Path) -> os.stat_result:
        status = lstat(path)
        return os.stat_result((*status[:4], OTHER, *status[5:])) if str(path) == wanted else status

    monkeypatch.setattr(Path, "lstat", as_if_owned)
    assert not is_trusted(folder)


def test_a_group_of_the_user_alone_may_write(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.chmod(0o770)
    for alone in (True, False):
        monkeypatch.setattr(trusted_folders, "_is_own_group", lambda number: alone)  # noqa: B023
        assert is_trusted(folder) is alone


def test_a_link_counts_as_where_it_leads(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(folder)
    assert is_trusted(tmp_path / "link")
    folder.chmod(0o777)
    assert not is_trusted(tmp_path / "link")


def test_what_is_not_there_is_not_trusted(tmp_path: Path) -> None:
    assert not is_trusted(tmp_path / "nothing")
    assert can_make(tmp_path / "nothing" / "more")
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared").chmod(0o777)
    assert not can_make(tmp_path / "shared" / "more")
    (tmp_path / "shared").chmod(0o1777)
    assert can_make(tmp_path / "shared" / "more")


@pytest.mark.parametrize("name", ["NUMBA_CACHE_DIR", "XDG_CACHE_HOME"])
def test_a_stated_folder_that_others_can_write_to_is_passed_over_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv(name, str(tmp_path))
    for mode, warned in ((0o700, False), (0o777, True)):
        tmp_path.chmod(mode)
        caplog.clear()
        kernel_cache.kernel_folders.cache_clear()
        with caplog.at_level(logging.WARNING, "stereophd"):
            kernel_cache.kernel_folders()
        assert any(f"{name}={tmp_path}" in record.getMessage() for record in caplog.records) is warned
    kernel_cache.kernel_folders.cache_clear()
