"""What a configuration says of the unknowns of a calibration, and how it is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereophd.commands.simulate import simulate
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.errors import InputError
from stereophd.pipeline.calibration.configured_unknowns import build_parameters, draw_guess
from stereophd.pipeline.calibration.problem import Outcome, annealed_task, part_used, read_problem
from stereophd.pipeline.calibration.report import build_report
from stereophd.report.summaries import verdict

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


def test_the_part_of_a_long_log_that_was_used_is_reported(tmp_path: Path) -> None:
    configuration = loaded("simulate.duration_s=5")
    simulate(configuration, tmp_path)
    log = tmp_path / "detections.parquet"
    whole = read_problem(configuration, log)
    most = len(whole.recording.pixels) // 3
    for changes, limit in (
        ([], None),
        ([f"calibration.annealed.max_detections={most}"], "calibration.annealed.max_detections"),
        (["calibration.annealed.max_events=6"], "calibration.annealed.max_events"),
    ):
        short = loaded("simulate.duration_s=5", *changes)
        section = short.config.calibration
        assert section is not None
        problem = read_problem(short, log)
        task = annealed_task(short, section, problem)
        used = part_used(problem, task)
        assert used["limited_by"] == limit
        assert (used["frames_tracked"] == len(whole.recording.cameras)) == (limit is None)
        outcome = Outcome.of_none(problem.parameters, "none agrees", {"input": {**problem.counts, **used}})
        report = build_report(section, problem, outcome, "cm")
        assert report["reason"].startswith("none agrees")
        assert report["reason"].count(limit or "calibration.annealed") == (limit is not None)
        assert verdict(report).count(limit or "calibration.annealed") == (limit is not None)
        is_part = used["detections_used"] < problem.counts["detections"]
        assert is_part == (limit == "calibration.annealed.max_detections")
        assert ("fitted to a part" in verdict({**report, "status": "determined", "reason": ""})) == is_part
