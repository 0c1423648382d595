"""Cost of the single-object estimators: disparity space beside particle filters, in one process.

The paper's Figure 11 (section VIII-B): an object that moves away from two cameras, 300 steps. Every estimator gets
the same detections; processor time of `step` for every event and `estimate` for every step, without making the data.
The repetitions go round all estimators in turn, and the best of each counts. Ends with 1 if disparity space with 256
samples costs more than a particle filter with 250.

python benchmarks/single_object.py [--repetitions N] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time

import numpy as np

from stereophd.core.disparity.events import Event, make_event, make_rig
from stereophd.core.disparity.prior import DisparityPrior, InitialPrior
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.numerics.samples import MomentsSettings
from stereophd.core.single.base import AnyEstimator
from stereophd.core.single.build import build_estimator
from stereophd.core.single.settings import DisparityChoice, EstimatorChoice, ParticleSettings
from stereophd.experiments.single_object import SingleObjectProblem, draw_trajectory

STEPS = 300
MOMENTS = {
    "disparity space, 64 qmc": MomentsSettings(method="qmc", samples=64),
    "disparity space, 256 qmc": MomentsSettings(method="qmc", samples=256),
    "disparity space, 250 particles": MomentsSettings(method="particle", samples=250),
    "disparity space, adaptive": MomentsSettings(method="adaptive", samples=256),
    "disparity space, linear": MomentsSettings(method="linear"),
}
ESTIMATORS: dict[str, EstimatorChoice] = {
    **dict.fromkeys(MOMENTS, DisparityChoice()),
    "particle filter, 250": ParticleSettings(particles=250),
    "particle filter, 500": ParticleSettings(particles=500),
    "particle filter, 1000": ParticleSettings(particles=1000),
}
OURS, BASELINE = "disparity space, 256 qmc", "particle filter, 250"


def main() -> int:
    """Measure, print, and say whether the target was met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=9)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    scenario = figure_eleven()
    events = draw_events(scenario, np.random.default_rng(1))
    estimators = {
        name: build_estimator(
            settings,
            MOMENTS.get(name, MomentsSettings()),
            scenario.rig,
            scenario.motion,
            scenario.prior,
            np.random.default_rng(2),
        )
        for name, settings in ESTIMATORS.items()
    }
    for estimator in estimators.values():
        seconds(estimator, events[:20])
    best = dict.fromkeys(estimators, math.inf)
    for _ in range(options.repetitions):
        for name, estimator in estimators.items():
            best[name] = min(best[name], seconds(estimator, events))
    rows = {name: {"us_per_event": 1e6 * s / len(events), "ratio": s / best[BASELINE]} for name, s in best.items()}
    if options.json:
        print(json.dumps(rows, indent=2))
    else:
        print(f"{'':34}us/event   of {BASELINE}")
        for name, row in rows.items():
            print(f"{name:34}{row['us_per_event']:8.1f}{row['ratio']:8.2f}")
    return int(rows[OURS]["ratio"] > 1.0)


def figure_eleven() -> SingleObjectProblem:
    """The scenario, as in configs/paper/single_object.yaml; lengths in cm."""
    cameras = [_camera("left", -20.0, -math.pi / 12), _camera("right", 20.0, math.pi / 12)]
    return SingleObjectProblem(
        make_rig(cameras, 1.0, "horizontal"),
        np.array([0.0, 0.0, 100.0, 0.0, 0.0, 6.0]),
        ConstantVelocity([0.05, 0.05, 0.1]),
        InitialPrior(disparity=DisparityPrior(mean_px=12.5, std_px=4.2), velocity_std=3.0),
        np.repeat(0.5 * np.arange(STEPS), 2),
        np.tile([0, 1], STEPS),
    )


def _camera(name: str, x: float, yaw: float) -> Camera:
    pose = Pose(rotation_from_vector(np.array([0.0, yaw, 0.0])), np.array([x, 0.0, 0.0]))
    detector = Detector((math.sqrt(2.0), math.sqrt(2.0)), 1.0, 0.0)
    return Camera(name, 800, 600, 8.0 / 8.9e-3, 8.0 / 9.0e-3, 400.0, 300.0, pose, Lens("none"), detector)


def draw_events(scenario: SingleObjectProblem, rng: np.random.Generator) -> list[Event]:
    """Detections of one trajectory."""
    events = []
    states = draw_trajectory(scenario, rng)
    for time_s, index, state in zip(scenario.times.tolist(), scenario.cameras.tolist(), states, strict=True):
        camera = scenario.rig.cameras[index]
        pixel = camera.project(state[None, :3]) + camera.detector.sigma * rng.standard_normal((1, 2))
        events.append(make_event(camera, index, time_s, pixel))
    return events


def seconds(estimator: AnyEstimator, events: list[Event]) -> float:
    """Processor time of a run, with an estimate after every second event."""
    start = time.process_time()
    state = estimator.init()
    for number, event in enumerate(events):
        state, _ = estimator.step(state, event)
        if number % 2:
            estimator.estimate(state)
    return time.process_time() - start


if __name__ == "__main__":
    sys.exit(main())
