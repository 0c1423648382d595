"""No value, however large, small or odd, gets past the configuration: every numeric key has bounds that are named."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from stereophd.config.loading import json_schema, load_config
from stereophd.errors import InputError

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"
# Numbers that no bound can name: infinity has a meaning there, or they only scale a figure's axis.
UNBOUNDED = {
    "PmbSettings.hypothesis_distance",
    "PmbSettings.exchange_above",
    "PhdSettings.out_of_view_s",
    "PmbSettings.out_of_view_s",
    "cameras_covariance",
}

CAMERA = "cameras.left"
SINGLE = "filter={kind: single, prior: {depth_range: [1, 9], velocity_std: 1}}"
CALIBRATION = "calibration={reference: left, priors: {right: {center_std: 1}}}"


def numbers(node: Any, name: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every node of a JSON schema that is a number, with the name of its key."""
    if isinstance(node, list):
        for item in node:
            yield from numbers(item, name)
    elif isinstance(node, dict):
        if node.get("type") in ("number", "integer"):
            yield name, node
        for word, below in node.items():
            if word == "properties":
                for key, value in below.items():
                    yield from numbers(value, f"{name}.{key}" if name else key)
            elif word != "$defs":
                yield from numbers(below, name)


def every_number() -> list[tuple[str, dict[str, Any]]]:
    """Return the numbers of all sections: ``Section.key`` and its schema."""
    schema = json_schema()
    found = list(numbers(schema, ""))
    for name, section in schema["$defs"].items():
        found += numbers(section, name)
    return found


def test_every_numeric_key_has_both_bounds() -> None:
    found = every_number()
    assert len(found) > 100
    bare = {
        name
        for name, node in found
        if not ({"minimum", "exclusiveMinimum"} & set(node) and {"maximum", "exclusiveMaximum"} & set(node))
    }
    assert bare == UNBOUNDED


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (f"{CAMERA}.pose.rotation_vector_deg=[1e300, 0, 0]", "rotation_vector_deg.0: expected a number <= 36000"),
        (f"{CAMERA}.pose.center=[0, -1e200, 0]", "pose.center.1: expected a number >= -1e+15"),
        (f"{CAMERA}.pose.velocity=[1e308, 0, 0]", "pose.velocity.0: expected a number <= 1e+15"),
        (f"{CAMERA}.pose.time_s=1e300", "pose.time_s: expected a number <= 1e+13"),
        (f"{CAMERA}.detector.sigma_px=[1e200, 1]", "sigma_px.0: expected a number <= 1e+06"),
        (f"{CAMERA}.detector.sigma_px=[1e-300, 1]", "sigma_px.0: expected a number >= 1e-06"),
        (f"{CAMERA}.detector.clutter_per_frame=1e15", "clutter_per_frame: expected a number <= 1e+06"),
        (f"{CAMERA}.readout_s=1e300", "readout_s: expected a number <= 1000"),
        (f"{CAMERA}.clock={{rate: 1e-300}}", "clock.rate: expected a number >= 1e-12"),
        (f"{CAMERA}.clock={{rate: 0}}", "clock.rate: expected a number > 0, found 0"),
        (f"{CAMERA}.distortion={{model: radial, k1: 1e300}}", "distortion.k1: expected a number <= 1e+06"),
        (f"{CAMERA}.image_size_px=[{10**30}, 480]", "image_size_px.0: expected a number <= 1000000"),
        (f"{CAMERA}.intrinsics.cx=1e300", "intrinsics.cx: expected a number <= 1e+09"),
        (f"{CAMERA}.intrinsics.fx=1e-300", "intrinsics.fx: expected a number >= 1e-09"),
        ("filter.birth.per_s=1e15", "filter.birth.per_s: expected a number <= 1e+06"),
        ("filter.extraction.confirm=.inf", "filter.extraction.confirm: expected a number <= 1, found Infinity"),
        ("filter.birth.velocity_std=.nan", "filter.birth.velocity_std: expected a number"),
        ("motion.acceleration_std=1e300", "motion.acceleration_std: expected a number <= 1e+15"),
        ("simulate.duration_s=1e30", "simulate.duration_s: expected a number <= 1e+13"),
        (f"seed={2**64}", "seed: expected a number <= 9223372036854775807"),
        (f"seed={'9' * 5000}", "expected an integer of at most 100 digits, found '999"),
        (f"seed=0x{'f' * 5000}", "expected an integer of at most 100 digits, found '0xfff"),
        (f"{'9' * 5000}=1", "unknown key"),
        (CALIBRATION.replace("center_std: 1", "center_std: 1e-300"), "of at least 1e-09, found 1e-300"),
        (CALIBRATION.replace("center_std: 1", "center_std: 1e300"), "center_std: expected a number <= 1e+15"),
        (CALIBRATION.replace("center_std: 1", "focal_std: 11"), "focal_std: expected a number <= 10"),
        (CALIBRATION.replace("center_std: 1", "rotation_std_deg: 4e4"), "rotation_std_deg: expected a number <= 36000"),
        (f"{CALIBRATION[:-1]}, smc: {{resample_below: 1}}}}", "smc.resample_below: expected a number <= 0.99, found 1"),
        (
            f"{CALIBRATION[:-1]}, scale: {{kind: speed, speed: 40, std: 1e-9}}}}",
            "scale.speed: std: expected at least 1e-09 of",
        ),
        (f"{SINGLE[:-2]}, x: 1}}}}", "filter.prior.x: unknown key"),
        (SINGLE.replace("velocity_std: 1", "velocity_std: 1e300"), "prior.velocity_std: expected a number <= 1e+15"),
        ('cameras="a\\0b.yaml"', "expected text of Unicode characters, without NUL"),
        ('cameras="\\ud800"', "expected "),
    ],
)
def test_a_value_beyond_all_sense_is_refused_with_its_bound(override: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        load_config(CONFIG, [override])
    message = str(caught.value)
    assert expected in message
    assert len(message) < 1000


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: &a {<<: *a}", "one that holds itself"),
        ("&a\nb: {<<: *a}", "one that holds itself"),
        ('"\\ud800": 1', "expected "),
        ("[" * 600, "nested too deeply"),
        ("{a: " * 2000, "nested too deeply"),
        ("a: !!float none", "expected a number, found 'none'"),
    ],
)
def test_an_odd_text_is_refused(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(InputError, match=expected):
        load_config(tmp_path / "config.yaml")


def test_a_path_with_nul_is_refused() -> None:
    with pytest.raises(InputError, match="expected the path of a file, found one with a NUL"):
        load_config("a\0b.yaml")


@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="this system has no /dev/zero")
def test_a_device_without_end_is_refused() -> None:
    with pytest.raises(InputError, match="expected a configuration of at most 8 MB, found more"):
        load_config("/dev/zero")
