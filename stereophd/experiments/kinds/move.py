"""A Gaussian carried from one disparity space to another, against a very large sample (paper, Figures 4 and 7).

The truth is the Gaussian of the same first two moments as a very large sample, carried over by the
textbook. What a method loses is the Kullback-Leibler divergence of that Gaussian from its own. The "bound" of a mean or
covariance is its value in the reference.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from stereophd.config.experiment import MoveScenario
from stereophd.config.loading import LoadedConfig
from stereophd.config.model import Config
from stereophd.core.arrays import Array
from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import OUT_OF_VIEW, Sources
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.random_streams import MOVE_REFERENCE, RUN_SINGLE_OBJECT
from stereophd.core.numerics.samples import SETS_IN_TURN, Method, MomentsSettings
from stereophd.core.single.build import sample_sets
from stereophd.errors import InputError, unknown_camera
from stereophd.experiments.engine.base import Kind, Series, scenario_of
from stereophd.io.outputs.provenance import canonical_json
from stereophd.pipeline.build import build_motion

AXES = ("u", "v", "d")

# Samples drawn at once, and fewest in view from which the reference is taken.
CLOUD = 200_000
MIN_SEEN = 1000

# Parts of the configuration that may differ between methods, and do not change what is carried over.
NOT_IN_REFERENCE = ("moments", "filter")


class OutOfViewError(ValueError):
    """Of a Gaussian that was carried over nothing is in view."""


@dataclass(frozen=True)
class MoveCase:
    """A Gaussian to carry over."""

    home: DisparitySpace
    destination: DisparitySpace
    # `mean`, `covariance`: arrays (6,), (6, 6): In the home space.
    mean: Array
    covariance: Array
    dt: float  # Interval, s
    motion: Motion


@dataclass(frozen=True)
class MoveMoments:
    """A Gaussian carried over by one method."""

    # `mean`, `covariance`: arrays (6,), (6, 6): Moments of the part in view of the destination's camera, in its
    # disparity space.
    mean: Array
    covariance: Array
    fraction: float  # Part in view
    divergence: float  # Kullback-Leibler divergence of the reference from this Gaussian, nat; 0 of the reference


def check(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless the cameras are there, and the motion is stated."""
    build_motion(loaded.config, loaded.path)
    names = [camera.name for camera in loaded.build_cameras()]
    for key in ("home", "destination"):
        name = getattr(scenario_of(loaded.config, MoveScenario), key)
        if name not in names:
            raise InputError(f"{loaded.path}: experiment.scenario.{key}: {unknown_camera(name, names)}")


def run(loaded: LoadedConfig, number: int) -> list[Series]:
    """Return the divergence of the reference from the Gaussian of the method, and that Gaussian's moments."""
    case, reference = _case(loaded)
    moments = loaded.config.moments
    rng = np.random.default_rng(RUN_SINGLE_OBJECT.seed(loaded.config.seed, number))
    comparison = compare_move(case, moments.method, moments.samples, reference, rng)
    return [Series("divergence", "nat", np.array([comparison.divergence])), *_moments(comparison)]


def bounds(loaded: LoadedConfig) -> list[Series]:
    """Return the moments of the reference."""
    return _moments(_case(loaded)[1])


def _case(loaded: LoadedConfig) -> tuple[MoveCase, MoveMoments]:
    """Return what is carried over, and the reference: the same for all methods and runs, and made once a process."""
    case_settings = {key: value for key, value in loaded.resolved.items() if key not in NOT_IN_REFERENCE}
    try:
        return _reference(canonical_json(case_settings))
    except OutOfViewError as error:
        raise InputError(f"{loaded.path}: experiment.scenario: {error}") from None


@lru_cache(maxsize=8)
def _reference(text: str) -> tuple[MoveCase, MoveMoments]:
    config = Config.model_validate_json(text)
    settings = scenario_of(config, MoveScenario)
    assert isinstance(config.cameras, dict)
    cameras = {name: camera.build(name) for name, camera in config.cameras.items()}
    home, destination = (
        DisparitySpace(cameras[name], config.disparity.baseline, config.disparity.rectification)
        for name in (settings.home, settings.destination)
    )
    rng = np.random.default_rng(MOVE_REFERENCE.seed(config.seed))
    point, stds, velocity = map(np.array, (settings.point_px, settings.std_px, settings.velocity))
    mean, covariance = gaussian_of_object(home, point, stds, velocity, settings.velocity_std, rng)
    case = MoveCase(home, destination, mean, covariance, settings.interval_s, config.motion.build())
    return case, reference_moments(case, rng, settings.reference_samples)


def _moments(moments: MoveMoments) -> list[Series]:
    """Return the mean and covariance of (u, v, d), and the share in view."""
    series = [Series("share_in_view", "1", np.array([moments.fraction]))]
    series += [Series(f"mean_{axis}", "px", moments.mean[i : i + 1]) for i, axis in enumerate(AXES)]
    pairs = [(i, j) for i in range(len(AXES)) for j in range(i, len(AXES))]
    series += [Series(f"covariance_{AXES[i]}{AXES[j]}", "px^2", moments.covariance[i, j : j + 1]) for i, j in pairs]
    return series


def gaussian_of_object(
    space: DisparitySpace, point: Array, stds: Array, velocity: Array, velocity_std: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Gaussian (6,), (6, 6) of an object at a disparity point (u, v, d) that moves with a velocity in the world.

    `point` and `stds` (3,) are mean and standard deviations of u, v and d, px; `velocity` (3,) and `velocity_std` those
    of the velocity, length/s. `rng` draws the sample whose moments give the velocity in disparity space.
    """
    points = point + rng.standard_normal((CLOUD, 3)) * stds
    velocities = velocity + rng.standard_normal((CLOUD, 3)) * velocity_std
    states = space.from_world(np.concatenate([space.to_world(points), velocities], axis=1))
    return states.mean(axis=0), np.cov(states.T)


def _draw(rng: np.random.Generator, mean: Array, covariance: Array, count: int) -> Array:
    """Draw from a Gaussian; its covariance may be singular.

    Raises LinAlgError when rounding has made a variance negative: the numbers are too far apart.
    """
    try:
        return rng.multivariate_normal(mean, covariance, count, check_valid="raise")
    except ValueError as error:
        raise np.linalg.LinAlgError(str(error).rstrip(".")) from error


def reference_moments(case: MoveCase, rng: np.random.Generator, samples: int) -> MoveMoments:
    """Moments of the part in view of a very large pseudo-random sample carried over by the textbook.

    Raises OutOfViewError when almost nothing of it is in view.
    """
    count = np.zeros(2)
    sums, squares = np.zeros(6), np.zeros((6, 6))
    transition, noise, drift = case.motion.transition(case.dt)
    # the rounding of the squares stays small about any point near the mean
    origin = case.destination.from_world((transition @ case.home.to_world(case.mean[None])[0] + drift)[None])[0]
    remaining = samples
    while remaining > 0:
        drawn = min(remaining, CLOUD)
        remaining -= drawn
        world = case.home.to_world(_draw(rng, case.mean, case.covariance, drawn))
        if case.motion.max_speed is not None:
            speed = np.linalg.norm(world[:, 3:], axis=1, keepdims=True)
            world[:, 3:] *= np.minimum(1.0, case.motion.max_speed / speed)
        world = world @ transition.T + drift + _draw(rng, np.zeros(6), noise, drawn)
        seen = case.destination.camera.in_view(world[:, :3])
        moved = case.destination.from_world(world[seen]) - origin
        count += drawn, len(moved)
        sums += moved.sum(axis=0)
        squares += moved.T @ moved
    if count[1] < MIN_SEEN:
        raise OutOfViewError(
            f"expected a Gaussian partly in view of {case.destination.camera.name}, found it out of view"
        )
    mean = sums / count[1]
    covariance = squares / count[1] - np.outer(mean, mean)
    return MoveMoments(origin + mean, covariance, float(count[1] / count[0]), 0.0)


def compare_move(
    case: MoveCase, method: Method, samples: int, reference: MoveMoments, rng: np.random.Generator
) -> MoveMoments:
    """Carry the Gaussian over by one method, once, with one of its sample sets, and compare with the reference."""
    settings = MomentsSettings(method=method, samples=samples)
    moved = move(
        Sources(
            case.mean[None], case.covariance[None], case.home.packed()[None], case.motion.arrays(np.array([case.dt]))
        ),
        case.destination.packed(),
        sample_sets(settings, case.motion, rng),
        int(rng.integers(SETS_IN_TURN)),
        important=np.array([True]),
    )
    if moved.status[0] == OUT_OF_VIEW:
        nothing = np.full(6, np.nan), np.full((6, 6), np.nan)
        return MoveMoments(*nothing, float(moved.fraction[0]), np.inf)
    mean, covariance = moved.means[0], moved.covariances[0]
    divergence = gaussian_divergence(reference.mean, reference.covariance, mean, covariance)
    return MoveMoments(mean, covariance, float(moved.fraction[0]), divergence)


def gaussian_divergence(mean: Array, covariance: Array, other_mean: Array, other_covariance: Array) -> float:
    """Kullback-Leibler divergence D(N(mean, covariance) || N(other_mean, other_covariance)), nat."""
    precision = np.linalg.inv(other_covariance)
    shift = other_mean - mean
    logs = np.linalg.slogdet(other_covariance)[1] - np.linalg.slogdet(covariance)[1]
    return float(0.5 * (np.trace(precision @ covariance) + shift @ precision @ shift - len(mean) + logs))


KIND = Kind(run, bounds, check)
