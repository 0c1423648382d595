"""Settings that no set-up has: `calibrate` finds nothing, or refuses them with their place, and always ends.

Each row is of a class of configurations that ended otherwise when `tests/fuzz` tried it first.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.commands.calibrate import calibrate
from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config
from stereophd.core.calibration.unknowns.observability import UNDETERMINED
from stereophd.errors import InputError

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "paper" / "calibration.yaml"
SMALL = (
    "simulate.duration_s=12",
    "simulate.objects.count=5",
    # one start, and no search for what may be otherwise than it is stated
    "calibration.annealed.starts=1",
    "calibration.model=as_stated",
    "calibration.annealed.min_detections=6",
    *(f"cameras.{name}.detector.clutter_per_frame=0.5" for name in ("left", "right")),
)
PRIOR = "calibration.priors.right"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("odd") / "scene"
    simulate(load_config(CONFIG, SMALL), folder)
    return folder


@pytest.mark.parametrize(
    "overrides",
    [
        # births far too close: no object, so no track whose clock could be compared
        ("filter.birth.disparity.mean_px=86000", f"{PRIOR}.clock_offset_std_s=0.002"),
        # both cameras at one place: objects lie in them
        ("cameras.right.pose.center=[-20, 0, 0]", "cameras.right.pose.rotation_vector_deg=[0, -15, 0]"),
    ],
)
def test_what_the_log_does_not_determine(scene: Path, tmp_path: Path, overrides: tuple[str, ...]) -> None:
    loaded = load_config(CONFIG, (*SMALL, *overrides))
    report = calibrate(loaded, scene / "detections.parquet", tmp_path / "out", plots=False, jobs=1)
    assert report["status"] == UNDETERMINED


@pytest.mark.parametrize(
    "overrides",
    [
        # far wider than the log: the shifts of the clock did not fit into the memory
        (f"{PRIOR}.clock_offset_std_s=1e13",),
    ],
)
def test_a_calibration_gives_a_result(scene: Path, tmp_path: Path, overrides: tuple[str, ...]) -> None:
    loaded = load_config(CONFIG, (*SMALL, *overrides), cameras_path=scene / "guess.yaml")
    calibrate(loaded, scene / "detections.parquet", tmp_path / "out", plots=False, jobs=1)
    posterior = pq.read_table(tmp_path / "out" / "posterior.parquet")
    assert posterior.num_rows
    assert all(np.isfinite(column.to_numpy()).all() for column in posterior.columns)


def test_a_prior_too_wide_to_draw_from(tmp_path: Path) -> None:
    """Of many draws about a rate of 1, one is negative."""
    config = load_config(CONFIG, (*SMALL, f"{PRIOR}.clock_rate_std=1e6"))
    place = "calibration.yaml: calibration.priors: a value drawn from a prior: right.clock.rate: "
    with pytest.raises(InputError, match=rf"{place}expected a number > 0, found -"):
        simulate(config, tmp_path / "out", runs=64)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "overrides",
    [
        ("calibration.method=sequential", "calibration.sequential.particles=1000000000"),
        ("calibration.posterior=smc", "calibration.smc.particles=1000000000"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused_before_it_begins(
    scene: Path, tmp_path: Path, overrides: tuple[str, ...]
) -> None:
    loaded = load_config(CONFIG, (*SMALL, *overrides))
    refusal = "detections.parquet: calibration: expected a run that fits into the memory"
    with pytest.raises(InputError, match=refusal):
        calibrate(loaded, scene / "detections.parquet", tmp_path / "out", plots=False, jobs=1)
    assert not (tmp_path / "out").exists()
