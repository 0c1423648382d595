"""Problems of bundle adjustment in which any quantity of three cameras is unknown."""

from collections.abc import Callable

import numpy as np

from stereophd.core.calibration.adjustment.problem import SQUARED, Loss, Observations, Problem
from stereophd.core.calibration.adjustment.trajectories import fit_states, interpolation, knot_spacing, place_knots
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.registry import quantities
from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.geometry.lens import Lens
from stereophd.core.motion.constant_velocity import ConstantVelocity
from tests.scenes import AROUND, build_camera

STDS = {
    "center": 0.3, "rotation": 0.02, "focal": 0.05, "aspect": 0.002, "principal_point": 8.0, "distortion": 0.02,
    "clock_offset": 0.1, "clock_rate": 1e-3, "readout": 0.05, "velocity": 0.01, "rotation_rate": 0.001,
}  # fmt: skip
SIGMA = 0.5
ACCELERATION = 0.1
MOTION = ConstantVelocity([ACCELERATION] * 3)


def rig(lens: str = "brown_conrady") -> tuple[Camera, ...]:
    """Three cameras around a stage of a few metres, of 10, 7 and 5 Hz."""
    lenses = {"none": Lens(), "brown_conrady": Lens("brown_conrady", k1=-0.1, k2=0.02, p1=0.001, p2=-0.001)}
    detector = {"noise": SIGMA, "p_detect": 1.0, "clutter": 0.0}
    return tuple(
        build_camera(
            f"cam{k}", *place, **detector, lens=lenses[lens], frame_rate_hz=rate,
            clock=Clock(0.05 * k, 1.0 + 1e-4 * k),
        )
        for k, (place, rate) in enumerate(zip(AROUND, (10.0, 7.0, 5.0), strict=True))
    )  # fmt: skip


ALIKE = np.eye(3)


def unknowns(cameras: tuple[Camera, ...], names: tuple[str, ...]) -> ParameterSet:
    """Priors of quantities of all cameras; the frame is that of the first."""
    return ParameterSet(
        cameras,
        tuple(
            Parameter(component, camera.name, 0.0, STDS[quantity.name])
            for k, camera in enumerate(cameras)
            for quantity in quantities()
            for component in quantity.components
            if quantity.name in names and component in quantity.available(camera) and (k or not quantity.of_the_frame)
        ),
    )


def in_turn(times: np.ndarray) -> np.ndarray:
    """Acceleration, over `ACCELERATION`, at times (n,) of objects that hover for two seconds and swerve for two."""
    return np.where(times % 4.0 < 2.0, 0.1, 2.0)


def observe(
    cameras: tuple[Camera, ...], seed: int, objects: int, seconds: float, mixed: np.ndarray = ALIKE,
    agility: Callable[[np.ndarray], np.ndarray] = np.ones_like,
) -> tuple[Observations, np.ndarray, np.ndarray]:  # fmt: skip
    """Detections of objects of white acceleration by true cameras, their true times and positions.

    `mixed` (3, 3) turns acceleration that is alike on all axes into another, which `agility` multiplies at times (n,).
    """
    rng = np.random.default_rng(seed)
    grid = np.arange(-1.0, seconds + 1.0, 0.005)
    kicks = mixed @ (agility(grid) * ACCELERATION * np.sqrt(0.005) * rng.standard_normal((objects, 3, len(grid))))
    velocity = rng.normal(0.0, 0.2, (objects, 3, 1)) + np.cumsum(kicks, axis=2)
    paths = rng.normal(0.0, 0.8, (objects, 3, 1)) + 0.005 * np.cumsum(velocity, axis=2)
    rows = [
        (j, k, t)
        for j in range(objects)
        for k, camera in enumerate(cameras)
        for t in np.arange(0.0, seconds, 1.0 / float(camera.frame_rate_hz or 1.0))
    ]
    of, number, log_times = (np.array(column) for column in zip(*rows, strict=True))
    delay, pixels, times = np.zeros(len(of)), np.empty((len(of), 2)), np.empty(len(of))
    points = np.empty((len(of), 3))
    for _ in range(3):  # the row of a detection depends on its time, and its time on the row
        for k, camera in enumerate(cameras):
            here = number == k
            times[here] = camera.clock.to_true(log_times[here]) + camera.readout_s * delay[here]
        for j in range(objects):
            here = of == j
            points[here] = np.column_stack([np.interp(times[here], grid, paths[j, axis]) for axis in range(3)])
        for n in range(len(of)):
            pixels[n] = cameras[number[n]].at(times[n]).project(points[n : n + 1])[0]
        delay = pixels[:, 1] / 600.0
    pixels += SIGMA * rng.standard_normal(pixels.shape)
    precisions = np.tile(np.eye(2) / SIGMA**2, (len(of), 1, 1))
    observations = Observations(of, number, times, pixels, precisions, log_times, pixels[:, 1] / 600.0)
    return observations, times, points


def problem_of(
    guess: ParameterSet, observations: Observations, points: np.ndarray, loss: Loss = SQUARED
) -> tuple[Problem, np.ndarray]:
    """The problem, its trajectories begun at the truth."""
    count = int(observations.trajectories.max()) + 1
    detected = [observations.times[observations.trajectories == j] for j in range(count)]
    knots = place_knots(detected, knot_spacing(MOTION, 0.005), MOTION)
    at = interpolation(knots, observations.trajectories, observations.times)
    states = fit_states(knots, *at, points, np.full(len(points), 1e4))
    return Problem(guess, 0, knots, observations, loss), states


def some_problem(names: tuple[str, ...], seed: int = 0, loss: Loss = SQUARED) -> tuple[Problem, np.ndarray, np.ndarray]:
    """A problem of three objects, its knots begun at the truth, and the true values."""
    true = unknowns(rig(), names)
    drawn = true.sample(np.random.default_rng(100 + seed), 1)[0]
    observations, _, points = observe(true.cameras, seed, 3, 8.0)
    problem, states = problem_of(true.about(true.guess(drawn)), observations, points, loss)
    return problem, states, drawn
