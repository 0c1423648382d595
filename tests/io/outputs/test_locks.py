"""One run at a time writes to an output folder."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

import stereophd.io.outputs.locks as locks
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.locks import LOCK_NAME, output_lock

PROGRAM = """
import sys
from stereophd.io.outputs.locks import output_lock
with output_lock(sys.argv[1]):
    print("locked", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other(tmp_path: Path):  # type: ignore[no-untyped-def]
    """Another process that writes to the folder ``out``."""
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "out")]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.communicate()


def test_the_second_run_is_refused_until_the_first_ends(tmp_path: Path, other: subprocess.Popen[str]) -> None:
    out = tmp_path / "out"
    for _ in range(2):
        with pytest.raises(InputError, match=f"another run is writing to it .process {other.pid} on"):
            OutputFolder(out, ["a"], force=True).__enter__()
    assert out.exists()
    other.communicate("")
    assert not out.exists()  # it made the folder, and left nothing in it
    with OutputFolder(out, ["a"]) as folder:
        folder.path("a").write_text("x")
    assert [path.name for path in out.iterdir()] == ["a"]


def test_the_lock_of_a_killed_run_holds_nobody_up(tmp_path: Path, other: subprocess.Popen[str]) -> None:
    other.kill()
    other.wait()
    assert (tmp_path / "out" / LOCK_NAME).exists()
    with OutputFolder(tmp_path / "out", ["a"]) as folder:
        folder.path("a").write_text("x")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a"]


def test_a_process_may_lock_a_folder_more_than_once(tmp_path: Path) -> None:
    with output_lock(tmp_path / "out"), output_lock(tmp_path / "." / "out"):
        assert (tmp_path / "out" / LOCK_NAME).exists()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["link", "hard link", "pipe", "folder"])
def test_a_lock_is_never_a_file_of_somebody_else(tmp_path: Path, kind: str) -> None:
    precious, out = tmp_path / "precious", tmp_path / "out"
    precious.write_text("mine")
    out.mkdir()
    if kind == "link":
        (out / LOCK_NAME).symlink_to(precious)
    elif kind == "hard link":
        os.link(precious, out / LOCK_NAME)
    elif kind == "pipe":
        os.mkfifo(out / LOCK_NAME)
    else:
        (out / LOCK_NAME).mkdir()
    with pytest.raises(InputError, match=f"{LOCK_NAME}: expected"), output_lock(out):
        pass
    assert precious.read_text() == "mine"


class TestWithoutLocksOfTheSystem:
    @pytest.fixture(autouse=True)
    def unsupported(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def flock(descriptor: int, operation: int) -> None:
            raise OSError(errno.ENOLCK, "No locks available")

        monkeypatch.setattr(locks.fcntl, "flock", flock)

    @pytest.mark.parametrize(
        ("owner", "refused"),
        [
            (f"process {os.getppid()} on {socket.gethostname()}", True),
            (f"process {os.getpid()} on {socket.gethostname()}", False),
            (f"process 999999999 on {socket.gethostname()}", False),
            ("process 1 on another-machine", True),
            ("", False),
        ],
        # the numbers differ from process to process, the names of the tests may not
        ids=["running", "own", "gone", "elsewhere", "nobody"],
    )
    def test_the_process_that_the_file_names_counts(self, tmp_path: Path, owner: str, refused: bool) -> None:
        (tmp_path / LOCK_NAME).write_text(owner)
        if refused:
            with pytest.raises(InputError, match="another run is writing"), output_lock(tmp_path):
                pass
        else:
            with output_lock(tmp_path):
                pass
            assert not list(tmp_path.iterdir())


def test_a_name_with_a_null_character_is_an_input_error() -> None:
    with pytest.raises(InputError, match="null character"), output_lock("a\0b"):
        pass
