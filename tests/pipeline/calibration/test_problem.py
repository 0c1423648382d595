"""What a configuration says of the unknowns of a calibration, and how it is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereophd.commands.simulate import simulate
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.errors import InputError
from stereophd.pipeline.calibration.problem import read_problem
from stereophd.pipeline.calibration.unknowns import build_parameters, draw_guess

CONFIG = Path(__file__).parents[3] / "configs" / "paper" / "calibration.yaml"
LENS = "cameras.right.distortion={model: radial, k1: -0.1}"
SAME = "cameras.left.distortion={model: radial, k1: -0.1}"


def loaded(*changes: str) -> LoadedConfig:
    return load_config(CONFIG, list(changes))


def test_all_quantities_have_priors_and_guesses() -> None:
    given: dict[str, Any] = {
        "focal_std": 0.2, "aspect_std": 0.002, "principal_point_std_px": 20, "clock_offset_std_s": 0.5,
        "clock_rate_std": 1.0e-3, "readout_std_s": 0.02,
    }  # fmt: skip
    changes = [f"calibration.priors.right.{key}={value}" for key, value in given.items()]
    configuration = loaded(LENS, "calibration.priors.right.distortion_std={k1: 0.1}", *changes)
    parameters, reference = build_parameters(configuration)
    assert reference == 0
    std = dict(zip(parameters.names, parameters.prior_std.tolist(), strict=True))
    assert std["right.focal"] == 0.2
    assert std["right.k1"] == 0.1
    assert std["right.rotation_y"] == pytest.approx(np.deg2rad(7.5))
    assert "right.k2" not in std
    guess = draw_guess(configuration, np.random.SeedSequence(1))
    true = configuration.build_cameras()
    found = build_parameters(configuration)[0].about([guess[camera.name].build(camera.name) for camera in true])
    # the truth is a draw from the prior about the guess: nothing is zero, nothing beyond five deviations
    drawn = np.abs(found.difference(true)) / parameters.prior_std
    assert (drawn > 0.0).all()
    assert (drawn < 5.0).all()


def test_an_unknown_focal_length_starts_at_the_width_of_the_image() -> None:
    camera = loaded("cameras.right.intrinsics={focal: unknown}").build_cameras(to_calibrate=True)[1]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (800.0, 800.0, 399.5, 299.5)
    with pytest.raises(InputError, match="focal"):
        loaded("cameras.right.intrinsics={focal: wide}")


def test_rates_of_a_moving_camera() -> None:
    parameters, _ = build_parameters(
        loaded("calibration.priors.right.velocity_std=0.1", "calibration.priors.right.rotation_rate_std_deg_s=0.1")
    )
    assert parameters.size == 12
    assert parameters.only_moves


def test_shared_intrinsics_are_one_parameter() -> None:
    prior = "{focal_std: 0.1, distortion_std: {k1: 0.05}}"
    changes = [LENS, SAME, f"calibration.priors.left={prior}", "calibration.priors.right.focal_std=0.1"]
    changes += ["calibration.priors.right.distortion_std={k1: 0.05}", "calibration.shared=[[left, right]]"]
    parameters, _ = build_parameters(loaded(*changes))
    assert parameters.names.count("left.focal") == 1
    assert "right.focal" not in parameters.names
    left, right = parameters.build(0.01 * np.arange(1.0, parameters.size + 1.0))
    assert left.fx == right.fx
    assert left.lens == right.lens


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["calibration.priors.left={center_std: 1.0}"], "expected no center_std for the reference left"),
        (["calibration.priors.left={clock_offset_std_s: 1.0}"], "expected no clock_offset_std_s for the reference"),
        (["calibration.priors.right.distortion_std={k1: 0.1}"], "expected coefficients of its lens model none"),
        ([LENS, "calibration.priors.right.distortion_std={k2: 0.1}"], r"lens model radial \(k1\), found k2"),
        (["calibration.priors.right.focal_sdt=0.1"], "focal_std"),
        ([LENS, "calibration.shared=[[left, right]]"], "expected cameras of the same intrinsics and lens"),
        (["calibration.shared=[[left, middle]]"], "expected one of the cameras left, right, found middle"),
        (["calibration.shared=[[left]]"], "groups of two or more"),
    ],
)
def test_bad_priors_are_refused(changes: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        build_parameters(loaded(*changes))


def test_a_log_of_more_detections_than_are_fitted_is_thinned(tmp_path: Path) -> None:
    configuration = loaded("simulate.duration_s=5")
    simulate(configuration, tmp_path)
    log = tmp_path / "detections.parquet"
    whole = read_problem(configuration, log).recording
    most = len(whole.pixels) // 3 + 1
    problem = read_problem(loaded("simulate.duration_s=5", f"calibration.annealed.max_detections={most}"), log)
    thinned = problem.recording
    assert problem.counts["frames_used"] == len(thinned.times) < len(whole.times)
    for camera in range(2):
        here, of_whole = np.flatnonzero(thinned.cameras == camera), np.flatnonzero(whole.cameras == camera)[::3]
        np.testing.assert_array_equal(thinned.times[here], whole.times[of_whole])
        for frame, other in zip(here, of_whole, strict=True):
            np.testing.assert_array_equal(
                thinned.pixels[thinned.first[frame] : thinned.first[frame + 1]],
                whole.pixels[whole.first[other] : whole.first[other + 1]],
            )
    assert len(thinned.sigma) == len(thinned.pixels) == thinned.first[-1]
