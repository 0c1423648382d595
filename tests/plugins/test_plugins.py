"""Plug-ins: a package of its own adds a format, a motion model, a filter and a lens by entry points.

The package lies in `example/`. It is not installed by pip, but found as an installed one is: by a folder `.dist-info`
with its entry points on the path of a process of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from stereophd.cli.app import run as command_line

EXAMPLE = Path(__file__).parent / "example"
ROOT = Path(__file__).parents[2]


def install(folder: Path, groups: dict[str, dict[str, str]], name: str = "stereophd-example") -> None:
    """Write what an installer leaves of a distribution: its metadata and entry points."""
    information = folder / f"{name.replace('-', '_')}-0.1.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
    lines = [
        f"[{group}]\n" + "".join(f"{word} = {value}\n" for word, value in words.items())
        for group, words in groups.items()
    ]
    (information / "entry_points.txt").write_text("\n".join(lines))


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    paths = [str(folder), str(EXAMPLE), str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    return subprocess.run(
        [sys.executable, "-m", "stereophd", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plugins")
    install(folder, tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"])
    return folder


def test_all_four_kinds_are_used_by_a_run(example: Path) -> None:
    log = ROOT / "sample_data" / "hall" / "detections.parquet"
    settings = {
        "motion": "{model: windy, acceleration_std: 0.3}",
        "filter": "{kind: cautious, survival_per_s: 0.95, "
        "birth: {per_s: 0.5, depth_range: [3.0, 14.0], velocity_std: 0.7}}",
        "cameras.right.distortion": "{model: barrel, k1: -0.1}",
    }
    config = example / "hall.yaml"
    text = (ROOT / "sample_data" / "hall.yaml").read_text()
    config.write_text(text.replace("$schema=../configs", f"$schema={ROOT}/configs"))
    words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    track = run(example, "track", str(config), str(log), "--out", "tracks", "-q", *words)
    assert track.returncode == 0, track.stderr
    export = run(example, "export", "semicolons", "tracks", "--out", "tracks.txt")
    assert export.returncode == 0, export.stderr
    tracks = {line.split(";")[1] for line in (example / "tracks.txt").read_text().splitlines()}
    assert len(tracks) >= 3
    # the same scene with the package's own words, in this process: the plug-ins are the same models under other names
    own = {
        "motion": "{model: constant_velocity, acceleration_std: 0.3}",
        "filter": settings["filter"].replace("cautious", "pmb"),
    }
    words = [word for key, value in own.items() for word in ("--set", f"{key}={value}")]
    assert command_line(["track", str(config), str(log), "--out", str(example / "own"), "-q", *words]) == 0
    assert run(example, "export", "semicolons", "own", "--out", "own.txt").returncode == 0
    assert (example / "own.txt").read_text() == (example / "tracks.txt").read_text()


def test_a_name_that_is_taken_is_refused(tmp_path: Path) -> None:
    install(tmp_path, {"stereophd.formats": {"csv": "stereophd_example.semicolons"}})
    result = run(tmp_path, "export", "csv", "tracks", "--out", "tracks.csv")
    assert result.returncode == 2
    assert "plug-in stereophd.formats: stereophd_example.semicolons of stereophd-example 0.1" in result.stderr
    assert "expected a name that is free, found csv" in result.stderr


def test_a_plug_in_that_cannot_be_imported_is_named(tmp_path: Path) -> None:
    install(tmp_path, {"stereophd.motion": {"windy": "stereophd_example.no_such_module"}})
    result = run(tmp_path, "config", "check", str(ROOT / "sample_data" / "hall.yaml"))
    assert result.returncode == 2
    assert "expected a module that can be imported, found ModuleNotFoundError" in result.stderr
