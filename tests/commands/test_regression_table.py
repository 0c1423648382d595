"""One table of filters and scenes: accuracy must not get worse unnoticed. A new filter is one row of `FILTERS`.

Margins. Thirty made-up scenes of the first kind (30 frames of `configs/paper/multi_object.yaml`, seeds 101 to
130, scored from t = 10 s) gave a mean OSPA with a mean of 1.02 (PHD) and 0.95 cm (PMB) and a standard deviation
from scene to scene of 0.32 and 0.29 cm; 6.4 (0.62) and 6.1 (0.31) identities for six objects. A row is the mean
over five other scenes; its limit is the mean of the thirty plus four standard errors of a mean of five:
1.02 + 4 * 0.32 / sqrt(5) = 1.6 and so on. A lost object costs 8.2 cm in every frame that it is lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from tests.shared_data import shared_data

pytestmark = pytest.mark.usefixtures("without_checks")

CONFIG = Path(__file__).parents[2] / "configs" / "paper" / "multi_object.yaml"
SEEDS = (1, 2, 3, 4, 5)
OBJECTS = 6
BIRTH = "{disparity: {mean_px: 7.0, std_px: 3.0}, velocity_std: 1.5}"


@dataclass(frozen=True)
class Row:
    """A filter, and what it must reach."""

    name: str
    overrides: tuple[str, ...]
    ospa: float  # mean over the seeds, cm
    identities: float  # per object


FILTERS = (
    Row("phd", (), ospa=1.6, identities=1.25),
    Row("pmb", (f"filter={{kind: pmb, birth: {BIRTH}}}",), ospa=1.5, identities=1.12),
)

# the same for shared scenes: mean OSPA from 50 s and of all, identities
SHARED = {"pmb": (1.0, 1.3, 8)}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Logs and truths of the seeds, the same for every filter."""
    folders = {}
    for seed in SEEDS:
        folders[seed] = tmp_path_factory.mktemp("scenes") / str(seed)
        simulate(load_config(CONFIG, ["simulate.duration_s=30.0"], seed), folders[seed])
    return folders


def ospa(out: Path, truth: Path, from_s: float | None) -> float:
    report = evaluate(out / "tracks.parquet", truth, order=2.0, cutoff=20.0, from_s=from_s)
    return float(report["ospa"]["mean"])


@pytest.mark.parametrize("row", FILTERS, ids=[row.name for row in FILTERS])
def test_made_up_scenes(row: Row, scenes: dict[int, Path], tmp_path: Path) -> None:
    scores, identities = [], []
    for seed, folder in scenes.items():
        loaded = load_config(CONFIG, list(row.overrides), seed)
        report = track(loaded, folder / "detections.parquet", tmp_path / str(seed))
        scores.append(ospa(tmp_path / str(seed), folder / "truth.parquet", 10.0))
        identities.append(len(report["tracks"]))
    assert np.mean(scores) <= row.ospa, scores
    assert OBJECTS <= np.mean(identities) <= row.identities * OBJECTS, identities


@pytest.mark.parametrize("scene", ["1", "2"])
@pytest.mark.parametrize("name", SHARED)
def test_shared_scenes(name: str, scene: str, tmp_path: Path) -> None:
    row = next(row for row in FILTERS if row.name == name)
    late, whole, identities = SHARED[name]
    data = shared_data("scene", scene)
    loaded = load_config(CONFIG, list(row.overrides), cameras_path=data / "cameras.yaml")
    report = track(loaded, data / "detections.parquet", tmp_path / "out")
    assert ospa(tmp_path / "out", data / "truth.parquet", 50.0) <= late
    assert ospa(tmp_path / "out", data / "truth.parquet", None) <= whole
    assert OBJECTS <= len(report["tracks"]) <= identities


def test_every_kind_of_filter_has_a_row() -> None:
    """Each `filter.kind` of the configuration is in the table."""
    from stereophd.config.loading import json_schema

    definitions = json_schema()["$defs"].values()
    kinds = {
        d["properties"]["kind"]["const"]
        for d in definitions
        if "survival_per_s" in d.get("properties", {}) and "kind" in d["properties"]
    }
    rows = {load_config(CONFIG, list(row.overrides)).config.filter.kind for row in FILTERS}  # type: ignore[union-attr]
    assert kinds == rows
    assert {"phd", "pmb"} <= kinds
