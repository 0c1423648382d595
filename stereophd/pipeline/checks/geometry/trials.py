"""Which mistake in cameras or clocks explains a log best: those of `alternatives`, and offsets and rates of clocks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise, product
from statistics import NormalDist

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.pipeline.checks.finding import CHECK_CAMERAS, DO_NOT_MEET
from stereophd.pipeline.checks.geometry.alternatives import Alternative, alternatives, posed
from stereophd.pipeline.checks.geometry.rays import (
    LEAST_SCORE,
    SHARP,
    TOLERANCES,
    Candidates,
    Geometry,
    Meeting,
    Rays,
    Reading,
    candidates,
    distances,
    meeting,
    nearest,
    pairs_of,
    pixels_at,
)
from stereophd.pipeline.checks.log.sample import CameraSample

# An alternative is named if it raises the excess by this much, to this multiple.
LEAST_GAIN, LEAST_RATIO = 0.08, 1.4
# Blocks of time that are taken to be independent of one another.
BLOCKS = 8
# Share of the logs of right set-ups in which chance may let any of the alternatives pass.
FALSE_ALARMS = 0.005
# Clock offsets that are tried: up to this many seconds, in this many steps.
LARGEST_SHIFT_S, SHIFT_STEPS = 6.0, 40
# Rates of clocks, frames of the first stretch that shows one, in which they drift little, and how many times
# longer each other one is.
RATES, FIRST_FRAMES, LONGER = (0.2, 5.0), 30, 4
SHIFT_DETECTIONS = 120
# Rates that are tried besides, as of a frame rate that is stated as half: where objects are slow, offsets show none.
USUAL_RATES = (0.5, 2.0, 1.0 / 3.0, 3.0, 0.25, 4.0)
# Offsets that are computed together: more would take much memory where frames have many detections.
SHIFTS_AT_ONCE = 40
# By how much finer the steps become about the best offset.
FINER = 4.0
# Clocks that are tried, and pairs of cameras for each: each is a search through many offsets.
MOST_CLOCKS, MOST_CLOCK_PAIRS = 12, 6
# Frames with detections below which no clock offset or rate can be estimated.
LEAST_CLOCK_FRAMES = 8
# Detections and shifted times of the first trial of an alternative, and alternatives that get a second one.
FEW_DETECTIONS, FEW_SHIFTS, FINALISTS = 50, 2, 6
# A pose is looked for from turns of these sizes about the axes, with these scales of the loss, one after the other,
# standard deviations, and so many steps; the standard deviation of its turn, rad, and of its move over the distance of
# the farthest camera; a miss without rays.
POSE_TURNS_DEG, POSE_SCALES, POSE_STEPS, POSE_STD, FARTHEST = (2.0, 4.0), (30.0, 3.0), 20, 0.2, 1e4
# Distances of a pair of cameras in a first trial, about, and detections that it has in any case.
QUICK_DISTANCES, LEAST_DETECTIONS = 8000, 8


def best_explanation(geometry: Geometry) -> Explanation | None:
    """Return the mistake that explains the log decisively better than the cameras as stated, if there is one.

    Every alternative is tried on a few detections, and the best of them on all: at the usual tolerances where rays are
    suspicious, and, if these name none, at one standard deviation, at which rays that are only near do not meet.
    """
    few = (pair.thinned(_affordable(pair, FEW_DETECTIONS, 1 + FEW_SHIFTS), FEW_SHIFTS) for pair in geometry.pairs)
    quick = replace(geometry, pairs=tuple(few), given=())
    # what holds at all tolerances is computed once
    of_clock, of_pose = cache(partial(_clock_trials, geometry)), cache(partial(_pose_trial, geometry))
    of_cameras, first_look = cache(lambda: [*_camera_trials(geometry)]), cache(lambda trial: trial.partners(quick))

    def best_at(tolerances: tuple[float, ...]) -> Explanation | None:
        stated = geometry
        if tolerances == SHARP:
            stated = replace(geometry, given=tuple(geometry.given_at(k, *SHARP) for k in range(len(geometry.pairs))))
        clocks = sorted(usable_clocks(stated)[:MOST_CLOCKS])  # of many, those whose rays meet least
        trials = [*of_cameras(), *(one for camera in clocks for one in of_clock(camera))]
        looks = [one for t in trials if (one := t.explain(quick, tolerances, first_look(t))) is not None]
        promising = [one for one in looks if one.met.excess >= one.given.excess + 0.5 * LEAST_GAIN]
        best_first = sorted(promising, key=lambda one: -one.met.sharpness)[:FINALISTS]
        finalists = sorted((one.trial for one in best_first), key=trials.index)
        scope = best_first[0].trial.scope[:FINALISTS] if best_first else _least_met(stated)[:1]
        finalists += [trial for camera in scope if (trial := of_pose(camera)) is not None]
        tried = sum(trial.tried for trial in trials)
        # a rate is found from two offsets
        least, of_rate = (NormalDist().inv_cdf(1.0 - FALSE_ALARMS / max(tried * n, 1)) for n in (1, SHIFT_STEPS))
        explained = [one for trial in finalists if (one := trial.explain(geometry, tolerances)) is not None]
        is_rate = [one.trial.cause == "frame_rate" and one.trial.tried > 1 for one in explained]
        certain = [one for one, of in zip(explained, is_rate, strict=True) if one.is_decisive(of_rate if of else least)]
        is_wrong = any(one.trial.cause != DO_NOT_MEET for one in certain)
        # where a usual mistake is certain, something is wrong: a pose that explains more, certain or not, competes
        compete = [one for one in explained if one in certain or (is_wrong and one.trial.cause == DO_NOT_MEET)]
        best = max((one.met.sharpness for one in compete), default=0.0)
        # of those that explain as much the first: the list begins with the likely ones
        alike = [one for one in compete if one.met.sharpness >= best - 0.03]
        return next((one for one in alike[:1] if is_wrong or _is_confirmed(one, geometry, tolerances, least)), None)

    return (best_at(TOLERANCES) if geometry.is_suspicious else None) or best_at(SHARP)


def _affordable(pair: Candidates, count: int, tables: int) -> int:
    """Return how many detections to take: fewer in crowds, where each has many candidates in every table."""
    return min(count, max(LEAST_DETECTIONS, QUICK_DISTANCES // (tables * int(pair.pixels_b.shape[2]))))


@dataclass(frozen=True, eq=False)
class Trial:
    """Cameras or clocks with one mistake undone."""

    scope: tuple[int, ...]  # Cameras that are changed
    cause: str
    text: str
    remedy: str
    views: list[Reading]
    samples: list[CameraSample] | None = None  # With other times; None: as they are
    change: str | None = None  # As that of a `Finding`
    tried: int = 1  # Number of trials that it was chosen from

    def partners(self, geometry: Geometry) -> list[tuple[int, Booleans, Array]]:
        """Return the pairs concerned by their numbers, which detections remain, and how far the nearest ray is then."""
        found: list[tuple[int, Booleans, Array]] = []
        for k, pair in enumerate(geometry.pairs):
            if {pair.a, pair.b}.isdisjoint(self.scope):
                continue
            there, (rays_a, rays_b) = pair, geometry.rays[k]
            known: Rays = (None if pair.a in self.scope else rays_a, None if pair.b in self.scope else rays_b)
            if self.samples is not None:
                count, shifts, known = len(pair.detections), len(pair.pixels_b) - 1, (None, None)
                moved = candidates(self.samples, pair.a, pair.b, count, shifts, among=pair.detections)
                if moved is None:
                    continue
                there = moved
            kept = np.isin(pair.detections, there.detections)
            found.append((k, kept, nearest(there, self.views[pair.a], self.views[pair.b], known)))
        return found

    def explain(
        self, geometry: Geometry, tolerances: tuple[float, ...] = TOLERANCES,
        partners: list[tuple[int, Booleans, Array]] | None = None,
    ) -> Explanation | None:  # fmt: skip
        """Return how much the change explains of the pairs concerned (see `partners`); None if it concerns none.

        Rays as stated are held to the tolerance at which those with the change meet best: at another one fewer meet.
        """
        after, before, changed = [], [], []
        for k, kept, least in self.partners(geometry) if partners is None else partners:
            after.append(met := meeting(least, tolerances))
            before.append(given := geometry.given_at(k, met.tolerance))
            changed.append(_changed(met.meets.astype(float) - given.meets[:, kept]))
        if not after:
            return None
        gain, variance = np.sum(changed, axis=0).tolist()
        return Explanation(self, _mean(after), _mean(before), gain / math.sqrt(max(variance, 1.0)))


@dataclass(frozen=True, eq=False)
class Explanation:
    """What the change of a trial explains of the log, over the pairs concerned."""

    trial: Trial
    # `met`, `given`: Means with the change and as stated, and the best score.
    met: Meeting
    given: Meeting
    # Detections that meet with the change and not as stated, less those that meet only as stated and what chance adds,
    # in standard deviations if either were as probable (Q. McNemar, "Note on the sampling error of the difference
    # between correlated proportions or percentages", 1947), where successive detections count as one (`_changed`).
    certainty: float

    def is_decisive(self, least: float) -> bool:
        """Whether far more rays meet with the change, at the `least` certainty."""
        met, given = self.met, self.given.excess
        is_more = met.excess >= max(given + LEAST_GAIN, LEAST_RATIO * given) and met.score >= LEAST_SCORE
        return is_more and self.certainty >= least


def _changed(change: Array) -> tuple[float, float]:
    """Return how many more detections meet with a change than chance lets them, and the variance of that by chance.

    Whether they meet with the change, less whether they do as stated, is given at the same times and at shifted ones,
    (1 + s, n), in the order of time. Objects that move along one epipolar line meet by chance again and again: sums
    over blocks at shifted times show how many detections count as one. The median leaves out a shift at which those
    of a wrong clock meet.
    """
    by_chance = change[1:] - change[1:].mean()
    blocks = np.unique(np.linspace(0, change.shape[1], BLOCKS, endpoint=False).astype(int))
    squares = (by_chance**2).sum(axis=1)
    lasting = np.median((np.add.reduceat(by_chance, blocks, axis=1) ** 2).sum(axis=1) / np.maximum(squares, 1e-9))
    count = (change[0] != 0.0).sum() + squares.mean() / len(by_chance)
    return float((change[0] - change[1:].mean()).sum()), float(max(lasting, 1.0) * count)


def _mean(meetings: list[Meeting]) -> Meeting:
    """Return the means of meetings, and their best score."""
    means = np.mean([(one.share, one.chance, one.excess, one.sharpness) for one in meetings], axis=0).tolist()
    best = max(meetings, key=lambda one: one.score)
    return replace(best, share=means[0], chance=means[1], excess=means[2], sharpness=means[3])


def _camera_trials(geometry: Geometry) -> Iterator[Trial]:
    everything = tuple(range(len(geometry.samples)))
    singles = [(c,) for c in everything]
    for alternative in alternatives():
        scopes: Sequence[tuple[int, ...]] = singles if alternative.alone else [everything, *singles]
        yield from (trial for scope in scopes if (trial := _trial(geometry, alternative, scope)) is not None)
    for a, b in pairs_of(len(everything)):
        views = geometry.views
        first, second = geometry.samples[a].camera, geometry.samples[b].camera
        views[a] = Reading(replace(second, detector=first.detector))
        views[b] = Reading(replace(first, detector=second.detector))
        yield Trial(
            (a, b), "cameras_exchanged", "their entries seem to be exchanged",
            "exchange the entries of the two cameras, or the names of their recordings (import with `rename`)", views,
        )  # fmt: skip


def _trial(geometry: Geometry, alternative: Alternative, scope: tuple[int, ...]) -> Trial | None:
    """Return a trial of an alternative with the cameras of a scope that it can concern; None if it is none of them."""
    changed = {c: view for c in scope if (view := alternative.apply(geometry.samples[c].camera)) is not None}
    if not changed:
        return None
    views = [changed.get(c, view) for c, view in enumerate(geometry.views)]
    return Trial(tuple(changed), alternative.cause, alternative.text, alternative.remedy, views)


def _pose_trial(geometry: Geometry, camera: int) -> Trial | None:
    """Return the trial of another pose of one camera: what errors of several kinds may pass for; None without rays.

    A mistake that a pose explains better is none. The pose is the one at which rays miss each other least in front of
    both cameras, those of a detection and of the nearest one of another camera; far misses count less and less.
    """
    stated, centers = geometry.samples[camera].camera, [s.camera.pose.center for s in geometry.samples]
    size = max(float(np.linalg.norm(centers[camera] - other)) for other in centers)
    concerned = _pairs_with(geometry, camera)[:MOST_CLOCK_PAIRS]

    def views(by: Array) -> list[Reading]:
        turned, center = rotation_from_vector(by[:3]) @ stated.pose.rotation, stated.pose.center + size * by[3:]
        moved = Reading(posed(stated, turned, center))
        return [moved if c == camera else view for c, view in enumerate(geometry.views)]

    def misses(by: Array) -> Array:
        found, of = [by / POSE_STD], views(by)
        for k in concerned:
            pair, (rays_a, rays_b) = geometry.pairs[k], geometry.rays[k]
            signed = distances(pair, of[pair.a], of[pair.b], (rays_a, rays_b[:1]))[0][0]
            signed = np.where(np.isfinite(signed), signed, FARTHEST)
            found.append(np.take_along_axis(signed, np.abs(signed).argmin(axis=1)[:, None], axis=1)[:, 0])
        return np.concatenate(found)

    # far misses have many minima: turns of a grid come first
    turns = np.deg2rad(
        [(*turn, 0.0, 0.0, 0.0) for step in POSE_TURNS_DEG for turn in product((0.0, -step, step), repeat=3)]
    )
    from scipy.optimize import least_squares  # costly to import, and seldom needed

    by = min(turns, key=lambda turn: float(np.log1p((misses(turn) / POSE_SCALES[0]) ** 2).sum()))
    if (misses(by)[len(by) :] == FARTHEST).all():  # as of cameras at one place
        return None
    for scale in POSE_SCALES:
        by = least_squares(misses, by, loss="cauchy", f_scale=scale, max_nfev=POSE_STEPS).x
    text = (
        f"a turn by {np.rad2deg(np.linalg.norm(by[:3])):.2g} degrees and a move explain more than any usual mistake: "
        "poses seem to be off, or clocks and lenses"
    )
    return Trial((camera,), DO_NOT_MEET, text, CHECK_CAMERAS, views(by))


def _is_confirmed(found: Explanation, geometry: Geometry, tolerances: tuple[float, ...], least: float) -> bool:
    """Whether a pose, if it is one, that is fitted to every other quarter of the log explains the others, too.

    Six numbers explain some of the detections that they are fitted to in any case.
    """
    if found.trial.cause != DO_NOT_MEET:
        return True
    samples, (camera,) = geometry.samples, found.trial.scope
    ends = np.quantile(samples[camera].times, (0.25, 0.5, 0.75))

    def quarters(first: int) -> Geometry:
        among = [np.searchsorted(ends, sample.times)[sample.frame_of] % 2 == first for sample in samples]
        pairs = (candidates(samples, p.a, p.b, among=np.flatnonzero(among[p.a])) for p in geometry.pairs)
        return replace(geometry, pairs=tuple(filter(None, pairs)), given=())

    trial = _pose_trial(quarters(0), camera)
    explained = None if trial is None else trial.explain(quarters(1), tolerances)
    return explained is not None and explained.is_decisive(least)


def usable_clocks(geometry: Geometry) -> list[int]:
    """Return cameras whose clocks can be examined (in a pair, with some frames), those whose rays meet least first."""
    return [c for c in _least_met(geometry) if len(geometry.samples[c].times) >= LEAST_CLOCK_FRAMES]


def _least_met(geometry: Geometry) -> list[int]:
    """Return the cameras that are in a pair, those whose rays meet least first."""
    of_camera = {c: of for c in range(len(geometry.samples)) if (of := _pairs_with(geometry, c))}
    return sorted(of_camera, key=lambda c: float(np.mean([geometry.given[k].excess for k in of_camera[c]])))


def _pairs_with(geometry: Geometry, camera: int) -> list[int]:
    """Return the numbers of the pairs of one camera."""
    return [k for k, pair in enumerate(geometry.pairs) if camera in (pair.a, pair.b)]


def _clock_trials(geometry: Geometry, camera: int) -> list[Trial]:
    """Return the trials of a clock offset and of a rate of one camera."""
    sample, concerned, found = geometry.samples[camera], _pairs_with(geometry, camera)[:MOST_CLOCK_PAIRS], []
    shift = _best_shift(geometry, concerned, camera)
    if shift is not None:
        found.append(Trial(
            (camera,), "clock_offset", f"its clock seems to be off by {-shift:+.3g} s", shift_remedy(shift),
            geometry.views, _with_times(geometry, camera, sample.times + shift), clock_change(sample, shift),
            SHIFT_STEPS,
        ))  # fmt: skip
    if (clock := _clock(geometry, concerned, camera)) is not None:
        found.append(replace(_of_rate(geometry, camera, *clock), tried=SHIFT_STEPS))
    start = float(sample.times[0])
    return [*found, *(_of_rate(geometry, camera, rate, (1.0 - rate) * start) for rate in USUAL_RATES)]


def _clock(geometry: Geometry, concerned: list[int], camera: int) -> tuple[float, float] | None:
    """Return the rate and the offset, s, that the times of a camera lack; None if their rate is right.

    They are those by which offsets of the two halves of a stretch differ: of a short one at first, in which times of
    another rate drift little, then of longer ones with the times that follow from it, up to the whole log.
    """
    sample, rate, offset = geometry.samples[camera], 1.0, 0.0
    count, lasts_s = len(sample.times), float(np.ptp(sample.times))
    shorter = [frames for k in range(count.bit_length()) if (frames := FIRST_FRAMES * LONGER**k) < count]
    for frames in (*shorter, count, count):  # a half has no one offset either: at the end once more
        samples = _with_times(geometry, camera, offset + rate * sample.times)
        found = []
        for start, end in pairwise(samples[camera].times[[0, frames // 2, frames - 1]]):
            pairs = (_within(samples, geometry.pairs[k], start, end) for k in concerned)
            if used := tuple(pair for pair in pairs if pair is not None):
                moved = replace(geometry, samples=samples, pairs=used, given=())
                shift = _best_shift(moved, list(range(len(used))), camera) or 0.0
                found.append((float(np.mean([pair.times.mean() for pair in used])), shift))
        if len(found) == 2 and found[1][0] > found[0][0]:
            (early, before), (late, after) = found
            faster = 1.0 + (after - before) / (late - early)
            if not RATES[0] < rate * faster < RATES[1]:  # offsets are those of chance, and times might run backwards
                return None
            rate, offset = rate * faster, offset * faster + before - (faster - 1.0) * early
    return (rate, offset) if abs(rate - 1.0) * lasts_s > 2.0 * sample.interval_s else None


def _within(samples: list[CameraSample], pair: Candidates, start: float, end: float) -> Candidates | None:
    """Return detections of A of a pair between two times, s, with those of B; None for none."""
    times = samples[pair.a].times[samples[pair.a].frame_of]
    among = np.flatnonzero((times >= start) & (times <= end))
    return candidates(samples, pair.a, pair.b, shifts=0, among=among)


def _of_rate(geometry: Geometry, camera: int, rate: float, offset: float) -> Trial:
    """Return the trial of times of a camera that run at this rate, beside this offset, s.

    Two cameras do not show which of them is wrong.
    """
    sample, inverse = geometry.samples[camera], f"{1.0 / rate:.4g}"
    text, remedy, by = f"its times seem to run at {inverse} times the true rate", "check its frame rate", f"{rate:.4g}"
    change: str | None = clock_change(sample, offset, rate)
    if len(geometry.samples) == 2:
        other = geometry.samples[1 - camera].camera.name
        text, remedy = f"its times seem to run at {inverse} times the rate of {other}", "check both frame rates"
        by, change = f"{by}, or those of {other} by {inverse}", None
    remedy += f"; import again with the true one (`rates`), or multiply its times by {by} (clock.rate)"
    samples = _with_times(geometry, camera, offset + rate * sample.times)
    return Trial((camera,), "frame_rate", text, remedy, geometry.views, samples, change)


def shift_remedy(shift_s: float) -> str:
    """Return what to do about a clock that must be shifted."""
    return f"add {shift_s:.4g} s to its clock (clock.offset_s), then run `init` again if it chose the settings"


def clock_change(sample: CameraSample, shift_s: float, rate: float = 1.0) -> str:
    """Return the change of the configuration by which true times become ``shift_s + rate * time``."""
    clock, key = sample.camera.clock, f"cameras.{sample.camera.name}.clock"
    offset = f"{rate * clock.offset_s + shift_s:.6g}"
    return f"{key}.offset_s={offset}" if rate == 1.0 else f"{key}={{offset_s: {offset}, rate: {rate * clock.rate:.7g}}}"


def _with_times(geometry: Geometry, camera: int, times: Array) -> list[CameraSample]:
    """Return the samples with other times of one camera; its one-camera tracks stay."""
    sample = geometry.samples[camera]
    moved = replace(sample, times=times)
    moved.__dict__.update(linking=sample.linking, alone=sample.alone)
    return [moved if k == camera else one for k, one in enumerate(geometry.samples)]


def _best_shift(geometry: Geometry, concerned: list[int], camera: int) -> float | None:
    """Return the clock offset, s, of a camera at which most rays meet; None if it is next to none.

    The steps become finer about the best offset: at a wide tolerance rays meet between the steps of a coarse grid.
    """
    interval = geometry.samples[camera].interval_s
    span = min(LARGEST_SHIFT_S, 0.25 * float(np.ptp(geometry.samples[camera].times)))
    best, step, finest = 0.0, max(interval / 4.0, 2.0 * span / SHIFT_STEPS), interval / 4.0
    while True:
        shifts = best + np.arange(-span, span + 0.5 * step, step)
        best = float(shifts[int(np.argmax(sum(_met_at(geometry, k, camera, shifts) for k in concerned)))])
        if step <= finest:
            return None if abs(best) < 0.5 * finest else best
        span, step = step, max(finest, step / FINER)


def _met_at(geometry: Geometry, k: int, camera: int, shifts: Array) -> Array:
    """Return the shares (n,) of rays of pair k that meet with these shifts of a clock, s, summed over tolerances."""
    pair, met = geometry.pairs[k], np.zeros(len(shifts))
    few = pair.thinned(_affordable(pair, SHIFT_DETECTIONS, -(-len(shifts) // 10)), 0)
    first, second = Reading(geometry.samples[pair.a].camera), Reading(geometry.samples[pair.b].camera)
    for block in np.array_split(np.arange(len(shifts)), -(-len(shifts) // SHIFTS_AT_ONCE)):
        # moving A's clock by s means looking at B at t + s
        at = few.times + (1.0 if camera == pair.a else -1.0) * shifts[block, None]
        seen = pixels_at(geometry.samples[pair.b], at.ravel())
        there = replace(few, pixels_b=seen.reshape(*at.shape, *seen.shape[1:]))
        meets = nearest(there, first, second) <= np.array((*SHARP, *TOLERANCES))[:, None, None]
        met[block] = meets.mean(axis=2).sum(axis=0)
    return met
