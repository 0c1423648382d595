"""The scene of a configuration, its objects drawn."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.config.model import Config
from stereophd.config.simulate import SimulateConfig
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.numerics.times import SAME_TIME_S
from stereophd.core.simulation.bodies import Body, BodyPoint
from stereophd.core.simulation.boxes import SizedObjects
from stereophd.core.simulation.detections import Scene
from stereophd.core.simulation.drawing import Drawing, draw_objects
from stereophd.core.simulation.objects import MovingObject, SceneObject
from stereophd.core.simulation.timing import Schedule, TimeGrid
from stereophd.core.simulation.walkers import Crowd, Walker
from stereophd.errors import InputError
from stereophd.wording import instant


def simulate_section(loaded: LoadedConfig) -> SimulateConfig:
    """Return the section ``simulate``; InputError if there is none."""
    if loaded.config.simulate is None:
        raise InputError(f"{loaded.path}: simulate: expected a section `simulate`, found none")
    return loaded.config.simulate


def scene_motion(config: Config) -> Motion:
    """Return how the objects of the ``simulate`` section of a configuration move."""
    settings = config.simulate
    assert settings is not None
    if settings.motion is not None:
        own: Any = settings.motion
        # a scene has no noise that it does not state
        if own.acceleration_std is None:
            own = replace(own, acceleration_std=0.0)
        built: Motion = own.build()
        return built
    tracked: Any = config.motion
    motion: Motion = replace(tracked, acceleration_std=settings.acceleration_std).build()
    # with a static model given objects keep the velocities that they are given
    return motion if motion.moves else ConstantVelocity(settings.acceleration_std)


def build_scene(config: Config, cameras: Sequence[Camera], seed: np.random.SeedSequence) -> Scene:
    """Return the scene of a configuration with a ``simulate`` section, its objects drawn with the seed.

    Raises InputError if an object's death lies before its birth, or no object fits into the view.
    """
    settings = config.simulate
    assert settings is not None
    start_s, end_s = settings.start_s, settings.start_s + settings.duration_s
    schedules = tuple(
        Schedule(camera.frame_rate_hz or settings.frame_rate_hz, start_s, end_s, camera.phase_s) for camera in cameras
    )
    _check_covered(cameras, schedules, start_s, end_s)
    truth = None if settings.truth_rate_hz is None else Schedule(settings.truth_rate_hz, start_s, end_s)
    grid = TimeGrid(schedules, truth)
    motion = scene_motion(config)
    given_seed, drawn_seed, body_seed, walker_seed = seed.spawn(4)
    objects: tuple[SceneObject, ...] = _given_objects(settings, grid.start_s, given_seed)
    if settings.objects is not None:
        drawn = settings.objects
        low, high = np.array([drawn.box.x, drawn.box.y, drawn.box.z]).T
        drawing = Drawing(
            drawn.count, low, high, drawn.velocity_std, drawn.stay_in_view, drawn.births_per_s, drawn.mean_lifetime_s
        )
        objects += draw_objects(drawing, cameras, grid, motion, drawn_seed, len(objects))
    objects += _body_points(settings, grid.start_s, body_seed, len(objects))
    if not isinstance(config.object, EllipsoidSettings):
        if settings.walkers is not None:
            raise InputError("simulate.walkers: expected object.shape ellipsoid with a ground, found point")
        return Scene(tuple(cameras), grid, objects, motion)
    return _with_sizes(Scene(tuple(cameras), grid, objects, motion), config.object, settings, walker_seed)


def _with_sizes(
    scene: Scene, shape: EllipsoidSettings, settings: SimulateConfig, seed: np.random.SeedSequence
) -> Scene:
    """Return a scene whose objects have sizes, and with its walkers."""
    for camera in scene.cameras:
        if camera.readout_s != 0.0:
            where = f"cameras.{camera.name}.readout_s"
            raise InputError(f"{where}: expected 0 where object.shape is ellipsoid, found {camera.readout_s:g}")
    generator, walkers = np.random.default_rng(seed), settings.walkers
    others, count = len(scene.objects), 0 if walkers is None else walkers.count
    log_axes = generator.multivariate_normal(*shape.log_axes(), others + count, method="cholesky")
    sized = SizedObjects(shape, log_axes)
    if walkers is None:
        return replace(scene, sized=sized)
    if shape.ground is None:
        raise InputError("simulate.walkers: expected object.ground, on which they walk, found none")
    up, area, start_s = shape.direction, walkers.area, scene.grid.start_s
    # places are given by the two axes of the world that are most along the ground
    *across, upright = np.argsort(np.abs(up), kind="stable").tolist()
    limits = np.array([area.x, area.y, area.z])[across]
    crowd = Crowd(count, limits[:, 0], limits[:, 1], walkers.speed, walkers.spacing, walkers.rest_s, walkers.meet)
    walked = crowd.walk(settings.duration_s, generator)
    axes = np.eye(3)[across] - np.outer(up[across] / up[upright], np.eye(3)[upright])
    heights = (
        up @ shape.ground.point + np.exp(log_axes[others:, 0]) + shape.ground.std * generator.standard_normal(count)
    )
    middles = np.outer(heights / up[upright], np.eye(3)[upright])
    people = tuple(Walker(others + k, start_s, walked[k], axes, middles[k]) for k in range(count))
    return replace(scene, objects=(*scene.objects, *people), sized=sized)


def _body_points(
    settings: SimulateConfig, start_s: float, seed: np.random.SeedSequence, first_id: int
) -> tuple[BodyPoint, ...]:
    """Points of the bodies of a scene, labelled from `first_id` on."""
    points: list[BodyPoint] = []
    for given, child in zip(settings.bodies, seed.spawn(len(settings.bodies)), strict=True):
        std = np.concatenate([np.array(given.center_std), np.deg2rad(given.rotation_std_deg)])
        turn = rotation_from_vector(np.deg2rad(given.rotation_vector_deg))
        body = Body.drawn(
            np.array(given.points), np.array(given.center), turn, std, given.period_s, start_s,
            np.random.default_rng(child),
        )  # fmt: skip
        points += [BodyPoint(first_id + len(points) + k, body, k, start_s) for k in range(len(given.points))]
    return tuple(points)


def _check_covered(cameras: Sequence[Camera], schedules: Sequence[Schedule], start_s: float, end_s: float) -> None:
    for camera, schedule in zip(cameras, schedules, strict=True):
        if camera.pose.path is None:
            continue
        first, last = camera.pose.span
        _, times = schedule.window(start_s, end_s)
        if not len(times):
            continue
        early, late = camera.readout_span
        begin, end = times[0] + early, times[-1] + late
        if not (first - SAME_TIME_S <= begin and end <= last + SAME_TIME_S):
            raise InputError(
                f"cameras.{camera.name}.pose.trajectory: expected poses that cover the frames of the run "
                f"({instant(begin, 10)} to {instant(end, 10)} s), found {instant(first, 10)} to {instant(last, 10)} s"
            )


def _given_objects(settings: SimulateConfig, start_s: float, seed: np.random.SeedSequence) -> tuple[MovingObject, ...]:
    noise_seeds = np.random.default_rng(seed).integers(0, np.iinfo(np.int64).max, len(settings.given))
    objects = []
    for index, given in enumerate(settings.given):
        birth_s = start_s if given.birth_s is None else given.birth_s
        death_s = np.inf if given.death_s is None else given.death_s
        if death_s < birth_s:
            raise InputError(f"simulate.given.{index}: expected birth_s <= death_s, found {birth_s:g} > {death_s:g}")
        position, velocity = np.array(given.position), np.array(given.velocity)
        objects.append(MovingObject(index, birth_s, float(death_s), position, velocity, int(noise_seeds[index])))
    return tuple(objects)
