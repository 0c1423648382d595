"""A small experiment: two objects, two methods, two baselines; a run takes a few milliseconds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from stereophd.config.loading import LoadedConfig, load_config

CONFIG: dict[str, Any] = {
    "units": {"length": "cm"},
    "seed": 3,
    "cameras": {
        name: {
            "image_size_px": [640, 480],
            "intrinsics": {"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0},
            "pose": {"center": [x, 0.0, 0.0]},
            "detector": {"sigma_px": [1.0, 1.0], "p_detect": 0.9, "clutter_per_frame": 2.0},
        }
        for name, x in (("left", -5.0), ("right", 5.0))
    },
    "motion": {"acceleration_std": 0.01, "max_speed": 5.0},
    "moments": {"samples": 64},
    "filter": {"kind": "phd", "birth": {"velocity_std": 1.0, "depth_range": [50, 200]}},
    "simulate": {
        "duration_s": 8,
        "objects": {
            "count": 2,
            "box": {"x": [-20, 20], "y": [-20, 20], "z": [80, 150]},
            "velocity_std": 0.5,
        },
    },
    "experiment": {
        "runs": 5,
        "scenario": {"kind": "multi_object", "ospa": [{"order": 2, "cutoff": 20}]},
        "methods": {
            "filter": {},
            "known association": {"experiment.scenario.tracker": "known_association"},
        },
        "cases": {"right camera at": {"key": "cameras.right.pose.center.0", "values": [0, 5], "unit": "cm"}},
        "windows": {"late": [4, 8]},
    },
}

Load = Callable[..., LoadedConfig]

# What `experiment` asks before it draws.
CAN_DRAW = "stereophd.commands.experiment.can_draw"


def write_config(target: Path) -> Path:
    """Write the small experiment to a file."""
    target.write_text(yaml.safe_dump(CONFIG, sort_keys=False))
    return target


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The small experiment as a file."""
    return write_config(tmp_path / "small.yaml")


@pytest.fixture
def load(path: Path) -> Load:
    """Return a function that loads the small experiment with overrides."""

    def function(*overrides: str) -> LoadedConfig:
        return load_config(path, overrides)

    return function


@pytest.fixture
def without_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Experiments in this process draw no figure, which takes longer than their runs."""
    monkeypatch.setattr(CAN_DRAW, lambda: False)
