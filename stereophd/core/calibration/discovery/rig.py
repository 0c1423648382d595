"""Several cameras from nothing: two by two, joined along the pairs of the greatest gain.

The first baseline along the tree is the unit of length. That of any other pair follows from the depths of the same
tracks at the same times before a camera that it shares with a pair already placed. A pair beside the tree whose optimum
agrees with the poses confirms the pairs between its cameras.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.discovery.pair_fit import PairFit, PairPrior
from stereophd.core.calibration.discovery.tracks import SlopeTracks, slope_tracks
from stereophd.core.calibration.discovery.two_cameras import LEAST_FRONT, PairResult, find_pair
from stereophd.core.calibration.discovery.verdict import doubts_of_pair, doubts_of_tracks
from stereophd.core.calibration.pairing.hypotheses import spanning_tree
from stereophd.core.calibration.time_limit import ENDLESS, TIME_OVER, TimeLimit
from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_to_vector
from stereophd.core.two_views.track_rays import RawTracks

# Depths of common samples that give the ratio of two baselines, at least.
LEAST_COMMON = 6
# Angles, rad, to which the optimum of a pair beside the tree agrees with the tree.
LOOP_ANGLE = np.deg2rad(6.0)


@dataclass(frozen=True)
class View:
    """A camera of unknown pose: its intrinsics, lens and clock are those of the prior mean."""

    camera: Camera
    focal_std: float  # relative; 0 if known
    lens_is_unknown: bool  # a first radial coefficient is looked for
    offset_std: float  # s; 0 if known, infinite if nothing is known
    rate_std: float


@dataclass(frozen=True)
class Spread:
    """Deviations of a camera that was found, as its tracks show them; 0 of what was known."""

    rotation: float  # rad
    direction: float  # of its centre from the reference: a share of the distance
    offset_s: float
    focal: float


@dataclass(frozen=True)
class FoundRig:
    """Cameras that were found."""

    cameras: tuple[Camera, ...]  # in the order of the views; the reference at the origin
    spreads: tuple[Spread, ...]
    pairs: tuple[PairResult, ...]  # those that join the cameras, the greatest gain first
    doubts: tuple[str, ...]  # why the cameras may be wrong; empty if they are believed

    def depth(self, reference: int) -> float:
        """Return the median depth of the objects before the reference, in units of the first baseline."""
        pair = next(pair for pair in self.pairs if reference in pair.cameras)
        return float(np.median(pair.best.depths[:, pair.cameras.index(reference)]))


@dataclass(frozen=True)
class Discovery:
    """What was found."""

    rig: FoundRig | None
    reason: str  # why nothing was found that is believed; empty if something was


def discover(
    views: Sequence[View], raw: RawTracks, reference: int, rng: np.random.Generator, limit: TimeLimit = ENDLESS
) -> Discovery:
    """Find poses, clocks and intrinsics of cameras from one-camera tracks: raw pixels on each camera's own clock.

    The reference camera is the origin, and its clock is true; `rng` chooses among hypotheses where there are too many.
    """
    names = [view.camera.name for view in views]
    found = slope_tracks([view.camera for view in views], raw)
    if (reason := doubts_of_tracks(found, names)) is not None:
        return Discovery(None, reason)
    results = {}
    every = list(combinations(range(len(views)), 2))
    for number, two in enumerate(every):
        stage = f"{names[two[0]]} and {names[two[1]]} are found from their tracks, pair {number + 1} of {len(every)}"
        if not limit.begin(stage):
            break
        prior, reach = _prior_of(views, two)
        result = find_pair(found, two, prior, reach, rng, partial(_tell_step, limit, stage))
        if result is not None:
            results[two] = result
    tree = spanning_tree({two: result.best.gain for two, result in results.items()})
    placed = {camera for two in tree for camera in two}
    if missing := [name for number, name in enumerate(names) if number not in placed]:
        if limit.is_over:
            return Discovery(None, f"{TIME_OVER} before {', '.join(missing)} could be found")
        return Discovery(None, f"no tracks of {', '.join(missing)} agree with those of another camera at any offset")
    if len(tree) < len(views) - 1:
        return Discovery(None, "the cameras fall into groups without common objects")
    chosen = [results[two] for two in tree]
    others = [results[two] for two in results if two not in tree]
    rig = _rig(views, found, reference, chosen, others)
    if rig is None:
        return Discovery(None, "no object is seen by three cameras at one time: the baselines cannot be compared")
    return Discovery(rig, "; ".join(rig.doubts))


def _tell_step(limit: TimeLimit, stage: str, step: str) -> None:
    limit.begin(f"{stage}, {step}")


def _prior_of(views: Sequence[View], two: tuple[int, int]) -> tuple[PairPrior, float]:
    """Prior of two cameras, and the reach of their clocks, s."""
    first, second = (views[number] for number in two)
    offset = float(np.hypot(first.offset_std, second.offset_std))
    prior = PairPrior(
        offset == 0.0, float(np.hypot(first.rate_std, second.rate_std)), (first.focal_std, second.focal_std),
        (first.lens_is_unknown, second.lens_is_unknown),
    )  # fmt: skip
    return prior, 4.0 * offset


def _rig(
    views: Sequence[View], found: SlopeTracks, reference: int, pairs: Sequence[PairResult], others: Sequence[PairResult]
) -> FoundRig | None:
    """Place cameras along the tree of pairs, the reference first; None if the baselines cannot be compared."""
    scales = _scales(found, reference, pairs)
    if scales is None:
        return None
    poses = {reference: Pose(np.eye(3), np.zeros(3))}
    clocks = {reference: (0.0, 1.0)}  # true time by the prior mean clock of each camera: offset and rate
    variances = {reference: np.zeros(3)}  # rotation, direction, offset
    while len(poses) < len(views):
        for pair, scale in zip(pairs, scales, strict=True):
            a, b = pair.cameras
            if (a in poses) == (b in poses):
                continue
            state, fit = pair.best.state, pair.best
            offset = state.pivot_s * (1.0 - state.rate) + state.offset_s  # of b by a
            if a in poses:
                turn, step, known, new = state.rotation, -scale * state.direction @ state.rotation, a, b
                relation = (offset, state.rate)
            else:
                turn, step, known, new = state.rotation.T, scale * state.direction, b, a
                relation = (-offset / state.rate, 1.0 / state.rate)
            pose = poses[known]
            poses[new] = Pose(turn @ pose.rotation, pose.center + step @ pose.rotation)
            clocks[new] = (clocks[known][0] + clocks[known][1] * relation[0], clocks[known][1] * relation[1])
            stds = np.array([fit.stds[:3].max(), fit.stds[3:5].max(), fit.stds[5]])
            variances[new] = variances[known] + stds**2
    cameras, spreads = [], []
    for number, view in enumerate(views):
        focal, focal_std = _averaged(pairs, number, 7)
        lens, _ = _averaged(pairs, number, 9)
        camera, clock = view.camera, clocks[number]
        cameras.append(replace(
            camera, pose=poses[number], fx=camera.fx * float(np.exp(focal)), fy=camera.fy * float(np.exp(focal)),
            lens=Lens("radial", k1=lens) if view.lens_is_unknown else camera.lens,
            clock=Clock(clock[0] + clock[1] * camera.clock.offset_s, clock[1] * camera.clock.rate),
        ))  # fmt: skip
        rotation, direction, offset = np.sqrt(variances[number]).tolist()
        spreads.append(Spread(rotation, direction, offset, focal_std))
    names = [view.camera.name for view in views]
    confirmed, closed = _confirmed(poses, pairs, others)
    doubts = [
        text
        for pair in pairs
        for text in doubts_of_pair(pair, names, pair.cameras in confirmed, pair.cameras in closed)
    ]
    return FoundRig(tuple(cameras), tuple(spreads), tuple(pairs), tuple(doubts))


def _confirmed(
    poses: Mapping[int, Pose], pairs: Sequence[PairResult], others: Sequence[PairResult]
) -> tuple[set[tuple[int, int]], set[tuple[int, int]]]:
    """Pairs of the tree on the way between two cameras whose own optimum, found without the tree, agrees with it.

    And those on the way between any two cameras that share tracks besides.
    """
    confirmed: set[tuple[int, int]] = set()
    closed: set[tuple[int, int]] = set()
    for other in others:
        if other.best.front < LEAST_FRONT:
            continue
        way = _way(other.cameras, [pair.cameras for pair in pairs])
        closed.update(way)
        a, b = (poses[number] for number in other.cameras)
        state, offset = other.best.state, b.rotation @ (a.center - b.center)
        turn = np.linalg.norm(rotation_to_vector(state.rotation @ (b.rotation @ a.rotation.T).T))
        cosine = float(state.direction @ offset) / max(float(np.linalg.norm(offset)), 1e-12)
        if max(turn, np.arccos(np.clip(cosine, -1.0, 1.0))) <= LOOP_ANGLE:
            confirmed.update(way)
    return confirmed, closed


def _way(ends: tuple[int, int], tree: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Pairs of a tree between two cameras."""
    ways: dict[int, list[tuple[int, int]]] = {ends[0]: []}
    while ends[1] not in ways:
        for a, b in tree:
            for known, new in ((a, b), (b, a)):
                if known in ways and new not in ways:
                    ways[new] = [*ways[known], (a, b)]
    return ways[ends[1]]


def _averaged(pairs: Sequence[PairResult], camera: int, component: int) -> tuple[float, float]:
    """Mean and deviation of the logarithm of a focal length (component 7) or of a lens (9), over pairs of a camera."""
    values, weights = [], []
    for pair in pairs:
        if camera not in pair.cameras:
            continue
        side, fit = pair.cameras.index(camera), pair.best
        if fit.stds[component + side] > 0.0:
            state = fit.state
            values.append(float(np.log(state.focal[side]) if component == 7 else state.lenses[side]))
            weights.append(float(fit.stds[component + side]) ** -2)
    if not values:
        return 0.0, 0.0
    return float(np.average(values, weights=weights)), float(min(weights) ** -0.5)


def _scales(found: SlopeTracks, reference: int, pairs: Sequence[PairResult]) -> list[float] | None:
    """Baselines of pairs in units of the first one at the reference; None if a pair has no common depths."""
    first = next(k for k, pair in enumerate(pairs) if reference in pair.cameras)
    scales = {first: 1.0}
    while len(scales) < len(pairs):
        ratios = [
            (len(ratio), new, scales[old] * float(np.median(ratio)))
            for new in range(len(pairs)) if new not in scales
            for old in scales
            for shared in set(pairs[new].cameras) & set(pairs[old].cameras)
            if len(ratio := _depth_ratios(pairs[old], pairs[new], shared)) >= LEAST_COMMON
        ]  # fmt: skip
        if not ratios:
            return None
        _, new, scale = max(ratios)
        scales[new] = scale
    return [scales[k] for k in range(len(pairs))]


def _depth_ratios(old: PairResult, new: PairResult, shared: int) -> Array:
    """Depths before a shared camera by one pair over those by another, at common times of the same tracks."""
    track, times, depths = _depths(old, shared)
    other_track, other_times, other_depths = _depths(new, shared)
    out = []
    for number in np.intersect1d(track, other_track):
        rows, others = track == number, other_track == number
        order = np.argsort(other_times[others])
        at, values = other_times[others][order], other_depths[others][order]
        common = (times[rows] >= at[0]) & (times[rows] <= at[-1])
        out.append(depths[rows][common] / np.interp(times[rows][common], at, values))
    return np.concatenate([np.empty(0), *out])


def _depths(pair: PairResult, camera: int) -> tuple[Array, Array, Array]:
    """Tracks of a camera of a pair, times on its clock, and depths before it."""
    fit: PairFit = pair.best
    if camera == pair.cameras[0]:
        return fit.samples[:, 0], fit.samples[:, 1], fit.depths[:, 0]
    return fit.samples[:, 2], fit.state.times_of_second(fit.samples[:, 1]), fit.depths[:, 1]
