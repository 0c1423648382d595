"""No configuration ends `calibrate` or `experiment` with an internal error, a library's warning, or not at all.

As in `test_configuration`, a few values of a small configuration that works are changed, most of them in the sections
that these commands read. Little memory is available, and a run that takes long is ended: that is no mistake.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config

from .commands import EXAMPLES, NoEnd, budget, changed, outcome
from .schema_values import Path as Keys
from .schema_values import fitting, leaves, near_bounds

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SCHEMA = json.loads((CONFIGS / "schema.json").read_text(encoding="utf-8"))

# Processor time, s, after which a run is ended, and memory that is available, bytes.
PATIENCE_S, MEMORY = 10.0, 1e9

# The parts of a configuration that most changes are made in; a name that comes twice is changed twice as often.
SECTIONS = ("calibration", "calibration", "experiment", "experiment", "cameras", "simulate", "filter", "motion")

# The camera that is unknown is the one that free names of the schema stand for.
CALIBRATION = {
    "reference": "right",
    "priors": {"left": {"center_std": 5.0, "rotation_std_deg": [1.0, 7.5, 1.0]}},
    "annealed": {"starts": 2, "min_detections": 6},
}
DETECTOR = {"sigma_px": [1.4, 1.4], "p_detect": 0.95, "clutter_per_frame": 0.5}
QUIET = [(("cameras", name, "detector"), DETECTOR) for name in ("left", "right")]


def _document(name: str, changes: list[tuple[Keys, Any]]) -> dict[str, Any]:
    """Return a configuration of the paper with what makes it small."""
    document = yaml.safe_load((CONFIGS / "paper" / name).read_text(encoding="utf-8"))
    return changed(document, changes)


SCENE = [*QUIET, (("simulate", "duration_s"), 10.0), (("simulate", "objects", "count"), 4)]
CALIBRATED = _document("calibration.yaml", [*SCENE, (("calibration",), CALIBRATION)])
RUNS = (("experiment", "runs"), 2)
EXPERIMENTS = {
    "table2": _document("table2.yaml", [RUNS]),
    "figure4": _document("figure4.yaml", [RUNS, (("experiment", "scenario", "reference_samples"), 2000)]),
    "figure10": _document("figure10.yaml", [RUNS, (("experiment", "scenario", "rounds"), 2)]),
    "figure11": _document(
        "figure11.yaml",
        [
            RUNS,
            (("experiment", "scenario", "steps"), 5),
            (("experiment", "scenario", "bound_trajectories"), 2),
            (("experiment", "windows"), {}),
            (("experiment", "table"), ["position_rmse"]),
        ],
    ),
    "figure12": _document("figure12.yaml", [RUNS, (("simulate", "duration_s"), 3.0), (("experiment", "windows"), {})]),
    "figure13": _document(
        "figure13.yaml",
        [
            RUNS,
            *SCENE,
            (("calibration",), CALIBRATION),
            (("experiment", "scenario"), {"kind": "calibration", "every_s": 4.0, "bound_scenes": 1}),
            (("experiment", "methods"), {"annealed": {}}),
        ],
    ),
    "static_scene": _document(
        "static_scene.yaml",
        [
            RUNS,
            (("simulate", "duration_s"), 3.0),
            (("experiment", "scenario", "bound_scenes"), 1),
            (("experiment", "cases"), {}),
        ],
    ),
}


def value_at(document: Any, path: Keys) -> Any:
    """Return the value at a path, or None."""
    for part in path:
        document = document.get(part) if isinstance(document, dict) else None
    return document


def changes_of(document: dict[str, Any], sections: Sequence[str]) -> st.SearchStrategy[list[tuple[Keys, Any]]]:
    """Return up to four changes, most of them to keys of some sections and to values that the schema accepts."""
    found = {
        path: node for path, node in leaves(SCHEMA, document=document) if value_at(document, path[:-1]) is not None
    }
    wholes = {path[:length] for path in found for length in range(len(path))}
    keys = sorted(((path, found[path]) for path in found if path not in wholes), key=lambda item: item[0])

    def change(item: tuple[Keys, Any]) -> st.SearchStrategy[tuple[Keys, Any]]:
        path, node = item
        sound = fitting(SCHEMA, node, value_at(document, path))
        values = st.sampled_from([sound] * 9 + [near_bounds(node)]).flatmap(lambda kind: kind)
        return st.tuples(st.just(path), values)

    groups = [[item for item in keys if item[0][0] == section] for section in sections if section in document]
    one = st.sampled_from([*groups, keys]).flatmap(st.sampled_from).flatmap(change)
    return st.lists(one, min_size=1, max_size=4)


@pytest.fixture(autouse=True)
def low_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs that need much memory are refused."""
    monkeypatch.setattr("stereophd.pipeline.runs.sizes.available_memory", lambda: MEMORY)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a log and of wrong cameras that can be calibrated with it."""
    folder = tmp_path_factory.mktemp("calibrated")
    (folder / "config.yaml").write_text(yaml.safe_dump(CALIBRATED))
    simulate(load_config(folder / "config.yaml"), folder / "scene")
    return folder / "scene"


def run_all(words: list[list[str]], capfd: pytest.CaptureFixture[str]) -> bool:
    """Run commands until one refuses its input, or takes long; return whether none did."""
    for command in words:
        try:
            code, said = outcome(command, capfd, PATIENCE_S)
        except NoEnd:
            return False
        assert code in (0, 2), f"{command[0]}: {said}"
        assert "Warning" not in said, said
        if code == 2:
            assert "error: " in said, said
            return False
    return True


@budget(max(EXAMPLES // 8, 1))
@given(
    changes=changes_of(CALIBRATED, SECTIONS),
    own_log=st.booleans(),
    plots=st.sampled_from(["--no-plots"] * 4 + ["--plots"]),
)
def test_calibrate(
    scene: Path, capfd: pytest.CaptureFixture[str], changes: list[tuple[Keys, Any]], own_log: bool, plots: str
) -> None:
    with tempfile.TemporaryDirectory() as name:
        config, out, log = Path(name, "config.yaml"), Path(name, "out"), scene
        config.write_text(yaml.safe_dump(changed(CALIBRATED, changes), allow_unicode=False), encoding="utf-8")
        words = [["config", "check", str(config)]]
        if own_log:
            log = Path(name, "scene")
            words.append(["simulate", str(config), "--out", str(log), "-q"])
        words.append(["calibrate", str(config), str(log / "detections.parquet"), "--out", str(out), "-q"])
        words[-1] += ["--jobs", "1", plots]
        if own_log:
            words[-1] += ["--cameras", str(log / "guess.yaml")]
        if run_all(words, capfd) and (out / "cameras.yaml").exists():
            assert run_all([["info", str(out / "cameras.yaml")], ["info", str(out)]], capfd)


@budget(max(EXAMPLES // 2, 1))
@given(
    case=st.sampled_from(sorted(EXPERIMENTS)).flatmap(
        lambda name: st.tuples(
            st.just(name),
            changes_of(EXPERIMENTS[name], SECTIONS),
        )
    ),
    draw=st.sampled_from([False] * 4 + [True]),
)
def test_experiment(capfd: pytest.CaptureFixture[str], case: tuple[str, list[tuple[Keys, Any]]], draw: bool) -> None:
    name, changes = case
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        if not draw:
            patch.setattr("stereophd.commands.experiment.can_draw", lambda: False)
        config = Path(folder, "config.yaml")
        config.write_text(yaml.safe_dump(changed(EXPERIMENTS[name], changes), allow_unicode=False), encoding="utf-8")
        out = str(Path(folder, "out"))
        run_all([["config", "check", str(config)], ["experiment", str(config), "--out", out, "-q"]], capfd)
