"""The table of `evaluate-cameras`: words and units, and nothing that is empty."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stereophd.cli.app import run
from stereophd.report.camera_scores import camera_scores_text

# Two cameras 10 cm apart; the estimate is 2 cm and 3 degrees off, and has another focal length, centre and clock.
CAMERAS = """units: {{length: cm}}
cameras:
  left:
    image_size_px: [640, 480]
    intrinsics: {{fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0}}
    pose: {{center: [0.0, 0.0, 0.0]}}
    detector: {{sigma_px: [1.0, 1.0], p_detect: 0.9, clutter_per_frame: 2.0}}
  right:
    image_size_px: [640, 480]
    intrinsics: {{fx: 500.0, fy: 500.0, cx: {cx}, cy: 240.0}}
    pose: {{center: [{x}, 0.0, 0.0], rotation_vector_deg: [0, {angle}, 0]}}
    detector: {{sigma_px: [1.0, 1.0], p_detect: 0.9, clutter_per_frame: 2.0}}
    clock: {{offset_s: {offset}}}
"""
TRUE = CAMERAS.format(cx=320.0, x=10.0, angle=0, offset=0.0)
WRONG = CAMERAS.format(cx=324.5, x=12.0, angle=3, offset=0.25)
OFFSET = "clock_offset s 0 0.25"
POSES = [
    "Errors of the poses relative to camera left",
    "  camera  rotation [deg]  direction [deg]  scale ratio  centre [cm]  centre after scale [cm]",
]


def rows(text: str) -> list[str]:
    """Lines with single spaces."""
    return [" ".join(line.split()) for line in text.splitlines()]


@pytest.mark.parametrize(
    ("estimate", "errors", "others", "unlike"),
    [
        (WRONG, "right 3 0 1.2 2 0", ["value unit left right", "principal_point_u px 0 4.5", OFFSET], "focal"),
        (TRUE, "right 0 0 1 0 0", ["none: intrinsics, lenses, clocks and movements are the true ones"], "clock_offset"),
    ],
)  # fmt: skip
def test_errors_of_two_files(
    estimate: str, errors: str, others: list[str], unlike: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "estimate.yaml").write_text(estimate)
    (tmp_path / "true.yaml").write_text(TRUE)
    words = ["evaluate-cameras", f"{tmp_path}/estimate.yaml", f"{tmp_path}/true.yaml"]
    assert run(words) == 0
    text = capsys.readouterr().out
    assert text.splitlines()[:2] == POSES
    assert rows(text)[2:] == [errors, "", "Other errors, estimated less true", *others]
    assert unlike not in text
    # the document has everything
    assert run([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["gates"] == []
    assert document["quantities"]["left"]["focal"] == 0.0


def test_limits_and_their_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, text in (("estimate", WRONG), ("true", TRUE)):
        (tmp_path / f"{name}.yaml").write_text(text)
    words = ["evaluate-cameras", f"{tmp_path}/estimate.yaml", f"{tmp_path}/true.yaml"]
    assert run([*words, "--fail-above", "joint.rotation_deg=0.5", "--fail-below", "joint.center=1"]) == 1
    assert rows(capsys.readouterr().out)[-4:] == [
        "Limits", "figure value fails if passed",
        "joint.rotation_deg 3 above 0.5 no", "joint.center 2 below 1 yes",
    ]  # fmt: skip


POSTERIOR = {
    "nees": 1.5, "covered_90": 0.5,
    "parameters": {
        "a.b.rotation_x": {"error": 0.0174532925, "std": 0.1745329252, "covered_90": True},
        "a.b.center_x": {"error": -1.0, "std": 0.25, "covered_90": False},
    },
}  # fmt: skip
BOUNDS = {"cameras": {}, "parameters": {"a.b.rotation_x": 0.0349065850, "a.b.velocity_x": 3.0}}


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (
            {"posterior": POSTERIOR},
            [
                "Parameters of the posterior", "parameter unit error std in 90 % interval",
                "a.b.rotation_x deg 1 10 yes", "a.b.center_x m -1 0.25 no",
                "NEES for each parameter: 1.5 (1 if consistent)", "50 % of the parameters lie in their 90 % intervals",
            ],
        ),
        (
            {"bounds": BOUNDS},
            [
                "Cramer-Rao bounds of the parameters", "parameter unit bound of std",
                "a.b.rotation_x deg 2", "a.b.velocity_x m/s 3",
            ],
        ),
        (
            {"posterior": POSTERIOR, "bounds": BOUNDS},
            [
                "Parameters of the posterior", "parameter unit error std in 90 % interval bound of std",
                "a.b.rotation_x deg 1 10 yes 2", "a.b.center_x m -1 0.25 no -", "a.b.velocity_x m/s - - - 3",
                "NEES for each parameter: 1.5 (1 if consistent)", "50 % of the parameters lie in their 90 % intervals",
            ],
        ),
    ],
    ids=["posterior", "bounds", "both"],
)  # fmt: skip
def test_parameters_have_units_and_bounds(more: dict, expected: list[str]) -> None:
    report = {
        "length_unit": "m", "reference": "a", "cameras": {}, "joint": {}, "quantities": {"a": {}, "a.b": {}},
        "gates": [], **more,
    }  # fmt: skip
    assert rows(camera_scores_text(report))[-len(expected) :] == expected
