"""`config check --for COMMAND` refuses what the command would refuse."""

from __future__ import annotations

from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from stereophd.cli.config import check_command
from stereophd.commands.check import COMMANDS, check_config
from stereophd.config.loading import load_config
from stereophd.errors import InputError

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
STATIC_SINGLE = "filter={kind: single, prior: {depth_range: [1, 9]}}"


def test_the_command_line_offers_every_command() -> None:
    offered = get_args(get_type_hints(check_command)["for_command"])[0]
    assert get_args(offered) == tuple(COMMANDS)


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("track", "quickstart.yaml"),
        ("simulate", "quickstart.yaml"),
        ("calibrate", "three_cameras_calibration.yaml"),
        ("experiment", "paper/table2.yaml"),
        (None, "quickstart.yaml"),
        (None, "paper/figure4.yaml"),
    ],
)
def test_what_is_complete_passes(command: str | None, name: str) -> None:
    check_config(load_config(CONFIGS / name), command)


@pytest.mark.parametrize(
    ("command", "override", "expected"),
    [
        ("track", "filter=null", "filter: expected a filter section, found none"),
        ("track", "cameras=null", "cameras: expected cameras"),
        ("track", "filter.birth.per_s=1e-12", "expected births that outlive prune_weight"),
        ("track", "motion={}", "motion.acceleration_std: expected by how much the velocity of objects changes"),
        ("track", STATIC_SINGLE, "filter.prior: expected velocity_std"),
        ("simulate", "simulate=null", "simulate: expected a section `simulate`"),
        ("simulate", "simulate.objects.box={x: [900, 901], y: [0, 1], z: [1, 2]}", "expected"),
        ("calibrate", "seed=1", "calibration: expected a section with a reference camera"),
        ("experiment", "seed=1", "experiment: expected a section `experiment`"),
    ],
)
def test_what_is_missing_is_named(command: str, override: str, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        check_config(load_config(CONFIGS / "quickstart.yaml", [override]), command)


def test_births_are_asked_beside_the_clutter_that_filters_expect() -> None:
    """Where none was stated every birth outlived, and the filter dropped it without a word."""
    names = load_config(CONFIGS / "quickstart.yaml").cameras
    none = [f"cameras.{name}.detector.clutter_per_frame=0.0" for name in names]
    with pytest.raises(InputError, match="expected births that outlive prune_weight"):
        check_config(load_config(CONFIGS / "quickstart.yaml", [*none, "filter.birth.per_s=1e-12"]), "track")
