"""A small configuration with its log, and the command line in this process or in one of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from stereophd.cli.app import run
from stereophd.io.logs.rows import LogWriter

CONFIG: dict[str, Any] = {
    "units": {"length": "cm"},
    "cameras": {
        name: {
            "image_size_px": [640, 480],
            "intrinsics": {"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0},
            "pose": {"center": [x, 0.0, 0.0]},
            "detector": {"sigma_px": [1.0, 1.0], "p_detect": 0.9, "clutter_per_frame": 2.0},
        }
        for name, x in (("left", -5.0), ("right", 5.0))
    },
    "motion": {"acceleration_std": 0.1, "max_speed": 5.0},
    "moments": {"samples": 64},
    "filter": {"kind": "phd", "birth": {"velocity_std": 1.0, "depth_range": [50, 200]}},
    "simulate": {
        "duration_s": 20,
        "given": [{"position": [0, 0, 100]}, {"position": [5, 5, 120], "velocity": [0, 0.5, 0]}],
        "object_id": True,
    },
}


@dataclass(frozen=True)
class Outcome:
    """What a call of the command line left behind."""

    code: int
    out: str
    err: str

    @property
    def sentence(self) -> str:
        """The one line on stderr of a failed call."""
        (line,) = self.err.splitlines()
        return line


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Return a function that calls the command line in this process."""

    def function(*words: Any) -> Outcome:
        capfd.readouterr()
        code = run([str(word) for word in words])
        out, err = capfd.readouterr()
        return Outcome(code, out, err)

    return function


def start(*words: Any, **options: Any) -> subprocess.Popen[str]:
    """Start the command line in a process of its own."""
    command = [sys.executable, "-m", "stereophd", *map(str, words)]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        **options,
    )


def write_config(path: Path, **changes: Any) -> Path:
    """Write the small configuration with some sections replaced."""
    path.write_text(yaml.safe_dump({**CONFIG, **changes}, sort_keys=False))
    return path


def write_log(path: Path, frames: int = 5, detections: int = 4) -> Path:
    """Write a log of clutter for the two cameras."""
    random = np.random.default_rng(0)
    with LogWriter(path) as writer:
        for frame in range(frames):
            for camera in ("left", "right"):
                writer.write(float(frame), camera, frame, random.uniform(0, 479, (detections, 2)))
    return path


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """The small configuration."""
    return write_config(tmp_path / "config.yaml")


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """The small log."""
    return write_log(tmp_path / "log.parquet")
