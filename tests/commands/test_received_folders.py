"""A received folder is data: whatever it holds, commands that read it change nothing, and those that write stay in it.

Each gift is a whole set of outputs with something that was made to harm. All commands run on it under a snapshot of
every file, link and folder below a temporary root.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from stereophd.commands.check import check
from stereophd.commands.evaluate import evaluate
from stereophd.commands.export import export
from stereophd.commands.info import info
from stereophd.commands.report import report
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import temporary_beside
from stereophd.io.outputs.commit import MOVING_IN, MOVING_OUT, beside_of
from stereophd.io.outputs.locks import LOCK_NAME
from stereophd.io.outputs.saved import MARK

from .test_track import SCENE

pytestmark = [
    pytest.mark.usefixtures("without_checks"),
    pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs links and pipes"),
]


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log, its truth, its cameras and its tracks in one folder."""
    folder = tmp_path_factory.mktemp("outputs")
    (folder / "scene.yaml").write_text(SCENE)
    loaded = load_config(folder / "scene.yaml", ["simulate.duration_s=1.0"])
    simulate(loaded, folder / "gift")
    track(loaded, folder / "gift" / "detections.parquet", folder / "tracked")
    for path in (folder / "tracked").iterdir():
        shutil.copy(path, folder / "gift")
    return folder


def old_journal(gift: Path, home: Path) -> None:
    """What an earlier version ran when the folder was read."""
    (gift / "sub").symlink_to(home)
    write(gift / ".stereophd-partial-commit" / "new" / "sub" / ".bashrc")
    (gift / ".stereophd-partial-commit" / "journal.json").write_text('{"stale": ["sub/thesis.tex", "report.json"]}')


def moves(name: str) -> Callable[[Path, Path], None]:
    """Moves that were not finished, into a link."""

    def make(gift: Path, home: Path) -> None:
        (gift / "sub").symlink_to(home)
        for inside in ("new", "old"):
            write(gift / name / inside / "sub" / ".bashrc")
            write(gift / name / inside / "report.json")

    return make


def linked_moves(gift: Path, home: Path) -> None:
    (gift / MOVING_IN).symlink_to(home)
    (gift / MOVING_OUT).symlink_to(home)


def linked_lock(gift: Path, home: Path) -> None:
    (gift / LOCK_NAME).symlink_to(home / "thesis.tex")


def hard_linked_lock(gift: Path, home: Path) -> None:
    os.link(home / "thesis.tex", gift / LOCK_NAME)


def pipes(gift: Path, home: Path) -> None:
    os.mkfifo(gift / LOCK_NAME)
    os.mkfifo(gift / f"{LOCK_NAME}.tmp")


def linked_temporary_files(gift: Path, home: Path) -> None:
    for name in ("report.html", "tracks.csv", "report.json"):
        temporary_beside(gift / name).symlink_to(home / "thesis.tex")
    beside_of(gift).symlink_to(home)


def linked_unfinished_run(gift: Path, home: Path) -> None:
    (gift / "partial-0123456789abcdef").symlink_to(home)


def unfinished_run(gift: Path, home: Path) -> None:
    folder = gift / "partial-0123456789abcdef"
    write(folder / "state.saved", MARK.decode() + "x\n")
    (folder / "tracks.parquet-00000.part").symlink_to(home / "thesis.tex")
    (folder / "deeper").symlink_to(home)


def linked_outputs(gift: Path, home: Path) -> None:
    for name in ("tracks.parquet", "report.json", "scans.parquet"):
        os.replace(gift / name, home / name)
        (gift / name).symlink_to(home / name)


HARMS = {
    "old journal": old_journal,
    "moves out": moves(MOVING_OUT),
    "moves in": moves(MOVING_IN),
    "links as moves": linked_moves,
    "link as lock": linked_lock,
    "hard link as lock": hard_linked_lock,
    "pipes": pipes,
    "links as temporary files": linked_temporary_files,
    "link as unfinished run": linked_unfinished_run,
    "unfinished run": unfinished_run,
    "links as outputs": linked_outputs,
}


def write(path: Path, text: str = "evil") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def snapshot(root: Path) -> dict[str, object]:
    """Return every file with its content and time, every link with its target, and every folder."""
    found: dict[str, object] = {}
    for path in sorted(root.rglob("*")):
        name, status = str(path.relative_to(root)), path.lstat()
        if path.is_symlink():
            found[name] = os.readlink(path)
        elif path.is_file():
            found[name] = (path.read_bytes(), status.st_mtime_ns, status.st_mode)
        else:
            found[name] = status.st_mode
    return found


def received(outputs: Path, root: Path, harm: str) -> tuple[Path, Path]:
    """Return a gift and the home of the one who reads it."""
    gift, home = root / "gift", root / "home"
    write(home / ".bashrc", "mine")
    write(home / "thesis.tex", "keep")
    shutil.copytree(outputs / "gift", gift)
    HARMS[harm](gift, home)
    return gift, home


@pytest.mark.parametrize("harm", HARMS)
def test_reading_changes_nothing(outputs: Path, tmp_path: Path, harm: str) -> None:
    root, out = tmp_path / "root", tmp_path / "out"
    gift, _ = received(outputs, root, harm)
    loaded = load_config(outputs / "scene.yaml")
    out.mkdir()
    before = snapshot(root)
    for number, read in enumerate(
        (
            lambda: info(gift),
            lambda: info(gift / "tracks.parquet"),
            lambda: info(gift / "cameras.yaml"),
            lambda: check(load_config(outputs / "scene.yaml", cameras_path=gift / "cameras.yaml"),
                          gift / "detections.parquet"),
            lambda: report([gift], out / "page.html"),
            lambda: evaluate(gift / "tracks.parquet", gift / "truth.parquet", out / "evaluated", plots=False),
            lambda: export("csv", gift, out / "tracks.csv"),
            lambda: export("opencv", gift / "cameras.yaml", out / "rig.yml"),
            lambda: track(loaded, gift / "detections.parquet", out / "tracked"),
        )
    ):  # fmt: skip
        # A folder between two runs is refused; all others are read.
        with contextlib.suppress(InputError) if harm.startswith("moves") else contextlib.nullcontext():
            read()
        assert snapshot(root) == before, number


@pytest.mark.parametrize("harm", HARMS)
def test_writing_into_it_changes_nothing_elsewhere(outputs: Path, tmp_path: Path, harm: str) -> None:
    root = tmp_path / "root"
    gift, home = received(outputs, root, harm)
    for name in ("detections.parquet", "truth.parquet", "cameras.yaml", "guess.yaml", "motion.parquet"):
        (gift / name).unlink(missing_ok=True)
    loaded, log = load_config(outputs / "scene.yaml"), outputs / "gift" / "detections.parquet"
    before = snapshot(home)
    for options in ({"resume": True}, {"force": True}):
        with contextlib.suppress(InputError):
            track(loaded, log, gift, **options)
        assert snapshot(home) == before
    for name in ("report.html", "tracks.csv"):
        with contextlib.suppress(InputError):
            report([outputs / "tracked"], gift / name, force=True)
        assert snapshot(home) == before
