"""Several cameras from nothing: two by two, joined to the reference along pairs that are believed.

The baseline of the first pair is the unit of length. That of any other pair follows from the depths of the same tracks
at the same times before a camera that it shares with a pair already placed. A pair is searched once more from where the
others place its cameras. What all of them show together is adjusted, and judged, afterwards.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.discovery.pair_fit import PairFit, PairPrior, PairProblem, PairState
from stereophd.core.calibration.discovery.tracks import SlopeTracks, slope_tracks
from stereophd.core.calibration.discovery.two_cameras import (
    OTHER_ANGLE,
    OTHER_STEPS,
    Link,
    PairResult,
    find_pair,
    with_start,
)
from stereophd.core.calibration.discovery.verdict import (
    MORE_OBJECTS,
    Doubt,
    doubts_of_pair,
    doubts_of_tracks,
    lead_of,
    sentences,
)
from stereophd.core.calibration.time_limit import ENDLESS, TIME_OVER, TimeLimit
from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_to_vector
from stereophd.core.two_views.track_rays import RawTracks

# Depths of common samples that give the ratio of two baselines, at least.
LEAST_COMMON = 6


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
    pairs: tuple[Link, ...]  # those that join the cameras, each to the reference or to one of those before it
    doubts: tuple[str, ...]  # why the cameras may be wrong; empty if they are believed

    def depths(self, reference: int) -> Array:
        """Return depths (n,) of the objects before the reference, in units of the first baseline."""
        pair = self.pairs[0]
        return np.asarray(pair.best.depths[:, pair.cameras.index(reference)])


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
    results: dict[tuple[int, int], PairResult] = {}
    placed = {reference: _Place(np.eye(3), 0.0, 1.0, np.zeros(3), ())}
    links: list[Link] = []
    while waiting := [number for number in range(len(views)) if number not in placed]:
        joined: tuple[int, list[Doubt], Link, _Place] | None = None
        for new, old in product(waiting, placed):
            two = (min(new, old), max(new, old))
            if two not in results:
                if not limit.begin(f"{names[two[0]]} and {names[two[1]]} are found from their tracks"):
                    break
                results[two] = find_pair(found, two, *_prior_of(views, two), rng)
                _close_loops(found, views, results, placed, links, new)
            if (link := _link(results, placed, new, names)) is not None:
                joined = min(joined or (new, *link), (new, *link), key=lambda e: (len(e[1]), -e[2].agreeing))
                if not joined[1] and (joined[2].agreeing > 1 or len(placed) == 1):
                    break
        if joined is None:
            missing = ", ".join(names[number] for number in waiting)
            if limit.is_over:
                return Discovery(None, f"{TIME_OVER} before {missing} could be found")
            known = ", ".join(names[number] for number in placed)
            when = " at any offset" if any(views[number].offset_std > 0.0 for number in waiting) else ""
            return Discovery(None, f"no tracks of {missing} agree with those of {known}{when}: {MORE_OBJECTS}")
        new, _, pair, placed[new] = joined
        links.append(pair)
    doubts: list[Doubt] = []
    for number, place in list(placed.items())[1:]:
        # judged by all others, but for those that were placed by it
        others = {other: at for other, at in placed.items() if other != number and number not in at.chain}
        last = _link(results, others, number, names)
        if last is not None:
            doubts += last[0]
            if not last[0] and place.distance(last[2])[0] > OTHER_ANGLE:
                doubts.append((f"the cameras do not agree where {names[number]} is", MORE_OBJECTS))
    said = sentences(doubts)
    rig = _rig(views, placed, links, said)
    if rig is None:
        few = "no object is seen by three cameras at one time: the baselines cannot be compared"
        return Discovery(None, "; ".join(said or [few]))
    return Discovery(rig, "; ".join(rig.doubts))


@dataclass(frozen=True)
class _Place:
    """A camera that is placed, or where a pair would place it, but for its centre."""

    rotation: Array  # (3, 3), from the axes of the reference
    later: float  # the reference's time less that by its clock, in the middle of the log, s
    rate: float
    variances: Array  # (3,): of rotation, direction and offset, as they add up along the chain of pairs
    chain: tuple[int, ...]  # the cameras by which it is placed

    def of_other(self, fit: PairFit, number: int, is_second: bool) -> "_Place":
        """Place the other camera of a pair, its second or its first, by this one, whose number is given."""
        state = fit.state
        variances = self.variances + np.array([fit.rotation_std, fit.direction_std, fit.stds[5]]) ** 2
        later, chain = self.rate * state.offset_s, (*self.chain, number)
        if is_second:
            return _Place(state.rotation @ self.rotation, self.later + later, self.rate * state.rate, variances, chain)
        rate = self.rate / state.rate
        return _Place(state.rotation.T @ self.rotation, self.later - later / state.rate, rate, variances, chain)

    def distance(self, other: "_Place") -> tuple[float, float]:
        """Return how far another place is turned, rad, and how much later its clock is, s."""
        return float(np.linalg.norm(rotation_to_vector(other.rotation @ self.rotation.T))), other.later - self.later


@dataclass(frozen=True, eq=False)
class _Option:
    """An optimum of a camera and one that is placed, and where it places the camera."""

    cameras: tuple[int, int]
    fit: PairFit
    place: _Place
    step: float  # of the offsets that were searched, s

    def agrees(self, other: "_Option") -> bool:
        """Whether it turns the camera and its clock as another does, as far as both state it."""
        turn, later = self.place.distance(other.place)
        stated = float(np.sqrt(self.place.variances[0] + other.place.variances[0]))
        return turn <= max(OTHER_ANGLE, stated) and abs(later) <= OTHER_STEPS * max(self.step, other.step)

    def group(self, options: Sequence["_Option"]) -> dict[tuple[int, int], "_Option"]:
        """Return it and, of each other pair, the option of the greatest gain that agrees with it.

        Points that lie behind a camera, where rays are nearly parallel, say nothing of turn and clock.
        """
        out = {self.cameras: self}
        for option in sorted(options, key=lambda option: -option.fit.gain_in_front):
            if option.agrees(self):
                out.setdefault(option.cameras, option)
        return out


def _link(
    results: Mapping[tuple[int, int], PairResult], placed: Mapping[int, _Place], new: int, names: Sequence[str]
) -> tuple[list[Doubt], Link, _Place] | None:
    """Join a camera to those that are placed, where all pairs with them gain most: doubts, pair and place.

    None if none of them pairs. An optimum of one pair gains what the optima of the others gain that turn the camera and
    its clock as it does. It is compared with optima that turn them otherwise, and with those that move the camera
    otherwise, without what both share. The pair that joins the camera is the one by which its direction is known best.
    """
    options = [
        _Option(two, fit, place.of_other(fit, old, new == two[1]), pair.step)
        for old, place in placed.items()
        if (pair := results.get(two := (min(new, old), max(new, old)))) is not None
        for fit in pair.fits
    ]
    if not options:
        return None

    def gain(group: Mapping[tuple[int, int], _Option], but: Mapping[tuple[int, int], _Option]) -> float:
        return sum(option.fit.gain_in_front for two, option in group.items() if but.get(two) is not option)

    groups = [option.group(options) for option in options]
    # of equal groups one about an optimum that has points in front of both cameras
    best = max(groups, key=lambda group: (gain(group, {}), next(iter(group.values())).fit.front > 0.0))
    first = next(iter(best.values()))
    rest = [option for option in options if option not in best.values()]
    moved = [option for option in rest if option.agrees(first)]
    others = [option.group(moved if option in moved else options) for option in rest]
    # what two poses share says nothing of which is right
    gains, other = min(
        (((gain(best, other), gain(other, best)), other) for other in others),
        key=lambda rival: lead_of(*rival[0]), default=((gain(best, {}), 0.0), best),
    )  # fmt: skip
    apart = first.place.distance(next(iter(other.values())).place)
    opposed = len({option.cameras for option in options}) - len(best)
    links = [
        (Link(option.cameras, option.fit, gains, apart, len(best), opposed), option.place) for option in best.values()
    ]
    return min(
        ((doubts_of_pair(link, names), link, place) for link, place in links),
        key=lambda entry: (len(entry[0]) > 0, entry[2].variances[1]),
    )


def _close_loops(
    found: SlopeTracks,
    views: Sequence[View],
    results: dict[tuple[int, int], PairResult],
    placed: Mapping[int, _Place],
    links: Sequence[Link],
    new: int,
) -> None:
    """Look for optima of the pairs of a new camera where each of its other pairs places it.

    Where rays are nearly parallel, the search of one pair may miss an optimum that gains more than any that it found.
    """
    pairs = {old: two for old in placed if (two := (min(new, old), max(new, old))) in results}
    for by, old in permutations(pairs, 2):
        two, guides = pairs[old], results[pairs[by]].fits
        if not guides:
            continue
        best = guides[0]
        joined = [*links, Link(pairs[by], best, (0.0, 0.0), (0.0, 0.0), 1, 0)]
        places = {**placed, new: placed[by].of_other(best, by, new == pairs[by][1])}
        centers = _centers(places, joined)
        if centers is None:
            continue
        first, second = (places[number] for number in two)
        apart = second.rotation @ (centers[two[0]] - centers[two[1]])
        focal, lenses = ([_averaged(joined, number, part)[0] for number in two] for part in (7, 9))
        state = PairState(
            second.rotation @ first.rotation.T, apart / np.linalg.norm(apart),
            (second.later - first.later) / first.rate, second.rate / first.rate, best.state.pivot_s, np.exp(focal),
            np.array(lenses),
        )  # fmt: skip
        problem = PairProblem(found, two, _prior_of(views, two)[0], results[two].step)
        results[two] = with_start(problem, results[two], state)


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
    views: Sequence[View], placed: Mapping[int, _Place], pairs: Sequence[Link], doubts: tuple[str, ...]
) -> FoundRig | None:
    """Return cameras that are placed, with centres along the pairs; None if the baselines cannot be compared."""
    centers = _centers(placed, pairs)
    if centers is None:
        return None
    cameras, spreads = [], []
    for number, view in enumerate(views):
        focal, focal_std = _averaged(pairs, number, 7)
        lens, _ = _averaged(pairs, number, 9)
        camera, place, middle = view.camera, placed[number], pairs[0].best.state.pivot_s
        offset = middle + place.later - place.rate * middle  # of the true time by the prior mean clock
        cameras.append(replace(
            camera, pose=Pose(place.rotation, centers[number]), fx=camera.fx * float(np.exp(focal)),
            fy=camera.fy * float(np.exp(focal)), lens=Lens("radial", k1=lens) if view.lens_is_unknown else camera.lens,
            clock=Clock(offset + place.rate * camera.clock.offset_s, place.rate * camera.clock.rate),
        ))  # fmt: skip
        rotation, direction, offset_std = np.sqrt(place.variances).tolist()
        spreads.append(Spread(rotation, direction, offset_std, focal_std))
    return FoundRig(tuple(cameras), tuple(spreads), tuple(pairs), doubts)


def _centers(placed: Mapping[int, _Place], pairs: Sequence[Link]) -> dict[int, Array] | None:
    """Centres of cameras along the pairs that join them; None if the baselines cannot be compared."""
    scales = _scales(pairs)
    if scales is None:
        return None
    centers = {next(iter(placed)): np.zeros(3)}
    for (a, b), state, scale in ((pair.cameras, pair.best.state, s) for pair, s in zip(pairs, scales, strict=True)):
        step = scale * state.direction @ placed[b].rotation  # from b's centre to a's
        centers |= {b: centers[a] - step} if a in centers else {a: centers[b] + step}
    return centers


def _averaged(pairs: Sequence[Link], camera: int, component: int) -> tuple[float, float]:
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


def _scales(pairs: Sequence[Link]) -> list[float] | None:
    """Baselines of pairs in units of the first one; None if a pair has no common depths."""
    scales = {0: 1.0}
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


def _depth_ratios(old: Link, new: Link, shared: int) -> Array:
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


def _depths(pair: Link, camera: int) -> tuple[Array, Array, Array]:
    """Tracks of a camera of a pair, times on its clock, and depths before it."""
    fit: PairFit = pair.best
    if camera == pair.cameras[0]:
        return fit.samples[:, 0], fit.samples[:, 1], fit.depths[:, 0]
    return fit.samples[:, 2], fit.state.times_of_second(fit.samples[:, 1]), fit.depths[:, 1]
