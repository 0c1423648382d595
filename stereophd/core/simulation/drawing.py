"""How the objects of a scene are drawn, so that they stay in view."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.simulation.objects import MovingObject, Path
from stereophd.core.simulation.timing import TimeGrid
from stereophd.errors import InputError

# Candidates for one object: drawn a batch at a time, given up after this many batches.
CANDIDATES_PER_BATCH = 256
MAX_BATCHES = 128
# Instants of its life at which a candidate without process noise is checked before the full check.
COARSE_INSTANTS = 9


@dataclass(frozen=True)
class Drawing:
    """How objects are drawn."""

    count: int  # objects alive at the start
    low: Array  # `low`, `high`: (3,): corners of the box in which positions at birth are uniform, world frame
    high: Array
    velocity_std: float  # of each component, length/s
    # in view of which cameras an object must be at every instant of its life
    stay_in_view: Literal["all", "any", "none"] = "all"
    births_per_s: float = 0.0  # rate of further objects (a Poisson process)
    mean_lifetime_s: float | None = None  # of an exponential lifetime; None: to the end of the run


def draw_objects(
    drawing: Drawing,
    cameras: Sequence[Camera],
    grid: TimeGrid,
    motion: Motion,
    seed: np.random.SeedSequence,
    first_id: int = 0,
) -> tuple[MovingObject, ...]:
    """Draw the objects of a scene, labelled from `first_id` on, in order of birth.

    Those that would leave the view are drawn again: birth and lifetime are drawn once, position, velocity and process
    noise until they fit, so that lifetimes keep their distribution. Raises InputError if no object stays in view in
    ``MAX_BATCHES * CANDIDATES_PER_BATCH`` draws.
    """
    count_seed, object_seed = seed.spawn(2)
    generator = np.random.default_rng(count_seed)
    duration_s = grid.end_s - grid.start_s
    births = generator.poisson(drawing.births_per_s * duration_s)
    birth_s = np.concatenate(
        [np.full(drawing.count, grid.start_s), np.sort(generator.uniform(grid.start_s, grid.end_s, births))]
    )
    drawn = []
    for index, (start_s, child) in enumerate(zip(birth_s, object_seed.spawn(birth_s.size), strict=True)):
        object_generator = np.random.default_rng(child)
        mean_s = drawing.mean_lifetime_s
        death_s = np.inf if mean_s is None else start_s + object_generator.exponential(mean_s)
        life = (first_id + index, float(start_s), float(death_s))
        drawn.append(_draw_one(drawing, cameras, grid, motion, object_generator, life))
    return tuple(drawn)


def _draw_one(
    drawing: Drawing,
    cameras: Sequence[Camera],
    grid: TimeGrid,
    motion: Motion,
    generator: np.random.Generator,
    life: tuple[int, float, float],
) -> MovingObject:
    for _ in range(MAX_BATCHES):
        positions = generator.uniform(drawing.low, drawing.high, (CANDIDATES_PER_BATCH, 3))
        velocities = drawing.velocity_std * generator.standard_normal((CANDIDATES_PER_BATCH, 3))
        seeds = generator.integers(0, np.iinfo(np.int64).max, CANDIDATES_PER_BATCH)
        last_s = life[1] if motion.noisy else min(life[2], grid.end_s)
        plausible = _stays_in_view_coarsely(
            drawing.stay_in_view, cameras, motion, positions, velocities, life[1], last_s
        )
        for index in np.flatnonzero(plausible):
            candidate = MovingObject(*life, positions[index], velocities[index], int(seeds[index]))
            if _stays_in_view(drawing.stay_in_view, cameras, grid, motion, candidate):
                return candidate
    raise InputError(
        f"simulate.objects: expected a box and velocities with which an object stays in view of "
        f"{drawing.stay_in_view} cameras throughout its life, found none in "
        f"{MAX_BATCHES * CANDIDATES_PER_BATCH} draws (box x {_range(drawing, 0)}, y {_range(drawing, 1)}, "
        f"z {_range(drawing, 2)}, velocity_std {drawing.velocity_std:g}, cameras "
        f"{', '.join(camera.name for camera in cameras)}); stay_in_view any or none asks less"
    )


def _range(drawing: Drawing, axis: int) -> str:
    return f"[{drawing.low[axis]:g}, {drawing.high[axis]:g}]"


def _stays_in_view_coarsely(
    stay_in_view: str,
    cameras: Sequence[Camera],
    motion: Motion,
    positions: Array,
    velocities: Array,
    first_s: float,
    last_s: float,
) -> Booleans:
    """Return which paths without noise (n,) are in view at a few instants: cheap, and most fail here."""
    if stay_in_view == "none":
        return np.ones(len(positions), dtype=np.bool_)
    # The last instant stays clear of the end, which no frame reaches.
    times_s = first_s + (last_s - first_s) * np.arange(COARSE_INSTANTS) / COARSE_INSTANTS
    flow = motion.flow(times_s - first_s)
    points = positions[:, None] + velocities[:, None] * flow.reach[:, None] + flow.drift[:, :3]
    places, instants = points.reshape(-1, 3), np.broadcast_to(times_s, points.shape[:2]).ravel()
    seen = np.stack([camera.contains(camera.project_at(places, instants)) for camera in cameras])
    seen = np.all(seen, axis=0) if stay_in_view == "all" else np.any(seen, axis=0)
    return np.asarray(seen.reshape(points.shape[:2]).all(axis=1), dtype=np.bool_)


def _stays_in_view(
    stay_in_view: str, cameras: Sequence[Camera], grid: TimeGrid, motion: Motion, candidate: MovingObject
) -> bool:
    if stay_in_view == "none":
        return True
    path = Path(candidate, motion)
    end_s = np.nextafter(candidate.death_s, np.inf)  # it still exists at its death
    for lower_s, upper_s in grid.windows():
        if upper_s <= candidate.birth_s:
            continue
        if lower_s >= end_s:
            break
        times_s = grid.times(max(lower_s, candidate.birth_s), min(upper_s, end_s))
        points = path.states(times_s)[:, :3]
        looks = (camera.contains(camera.project_at(points, times_s)) for camera in cameras)
        # most candidates that leave leave the view of the first cameras: the others need not look
        if not (all(look.all() for look in looks) if stay_in_view == "all" else np.any(list(looks), axis=0).all()):
            return False
    return True
