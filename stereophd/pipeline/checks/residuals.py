"""Small errors of clock, shutter, lens and pose: rays meet, but miss each other by what these would cause.

One-camera tracks of two cameras that meet most of the time belong to one object. The signed distance of their rays from
meeting, in standard deviations, is white noise of mean 0 if the set-up is right. Whatever is wrong with a camera shifts
its pixels: a late clock by what the object moves in that time, a shutter by that times the row, a lens from the centre
outwards, a turn all alike. All distances of a camera are regressed on these shifts. Of causes that explain much the
same the simplest is named. Standard errors follow from the spread between one-camera tracks, so that an error that
lasts for one of them counts once. An object whose detections lie beside it all the time has several of these tracks,
and that is evidence.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.pipeline.checks.finding import CHECK_CAMERAS, DO_NOT_MEET, ERRORS_LAST, LASTING_REMEDY, Finding
from stereophd.pipeline.checks.geometry.alternatives import posed
from stereophd.pipeline.checks.geometry.partners import (
    FARTHEST,
    LEAST_COMMON,
    MOST_WRONG,
    Partners,
    partners,
    track_motion,
)
from stereophd.pipeline.checks.geometry.ray_checks import CHANCE_SCORE
from stereophd.pipeline.checks.geometry.rays import TOLERANCES, Geometry, signed_distances
from stereophd.pipeline.checks.geometry.trials import clock_change, shift_remedy
from stereophd.pipeline.checks.log.sample import CameraSample
from stereophd.wording import percent

# Share of the logs of right set-ups in which chance may let any of the causes pass, the shift that any camera may have,
# in standard deviations of a detection (a track is several times as certain as one), and the square of each part of
# it, in variances, below which no such chance is left.
FALSE_ALARMS, TOLERATED, LEAST_SQUARE = 0.001, 0.1, 9.0
# A cause explains as much as another if what they explain differs by less than this many times its root, by which
# noise changes it, in deviations of what is left.
ALIKE = 2.0
# Distances last if the mean product of successive ones exceeds this part of the variance of a detection, of which a
# track averages several, and so many errors of white noise, for so many pairs of tracks; a cause must leave less than
# this share of what lasts. Beyond the whole variance of a detection cameras do not agree.
LASTING, LASTING_ERRORS, LEAST_TRACKS, MOST_LEFT = 0.1, 4.0, 8, 0.25
# Steps of numerical derivatives: s, and of the numbers that change a camera, those of lenses as large as of wide ones.
STEP_S, STEPS = 1e-5, (1e-5, 1e-5, 1e-5, 1e-5, -0.2, -1.0)
PRIORS = "let calibrate estimate it (calibration.priors.NAME"
ESTIMATE_LENS, ESTIMATE_READOUT = f"{PRIORS}.distortion_std: {{k1: 0.1}})", f"{PRIORS}.readout_std_s)"
REFINE = "let calibrate refine the poses, starting from these cameras"


class Cause(NamedTuple):
    """What may be wrong with a camera, or with all of them alike, and shifts its pixels."""

    name: str
    what: str  # What is wrong, for a list
    numbers: tuple[int, ...]  # Places among the numbers of `shifts_of`
    text: str  # What the distances do, and why
    remedy: str
    of_boxes: bool = True  # Whether it shows in middles of boxes, which are not the image of one point


# Places among the numbers of `shifts_of`.
TURNS, FOCAL, LENS, STATED, CLOCK, SHUTTER, RATE = (0, 1, 2), 3, 4, 5, 6, 7, 8
LENS_MISSING = Cause(
    "lens_missing", "lens", (LENS,),
    "grow from the centre of the image outwards: a lens seems to be missing, near k1 = {value:.2g}",
    f"state the lens distortion (import without `pixels_undistorted`), or {ESTIMATE_LENS}",
)  # fmt: skip
LENS_INACCURATE = Cause(
    "lens_inaccurate", "lens", (STATED,),
    "grow from the centre of the image outwards: the lens seems to be {factor:.2f} times as strong as stated (at 0 the "
    "pixels are undistorted already)",
    "leave the distortion out if the pixels are undistorted already (import with `pixels_undistorted`), else calibrate "
    f"the lens again, or {ESTIMATE_LENS}",
)  # fmt: skip
CAUSES = (
    Cause(
        "clock_offset", "clock", (CLOCK,),
        "follow the speed of the objects: its clock seems to be off by {value:+.3g} s", "",
    ),
    Cause(
        "clock_rate", "rate of the clock", (RATE, CLOCK),
        "follow the speed of the objects times the time that passes: the times of {name} seem to run at "
        "{factor:.5g} times the rate of those of other cameras",
        "check the frame rates from which times were computed; import again with the true ones (`rates`), or multiply "
        "its times by",
    ),
    Cause(
        "readout_inaccurate", "shutter", (SHUTTER,),
        "follow the speed of the objects times the row: its shutter seems to take {value:+.2g} s more than stated",
        f"state readout_s, or {ESTIMATE_READOUT}",
    ),
    LENS_MISSING,
    LENS_INACCURATE,
    Cause(
        "focal_inaccurate", "focal length", (FOCAL,),
        "grow from the centre of the image outwards: its focal length seems to be {factor:.4g} times the stated one",
        f"calibrate the camera again, or {PRIORS}.focal_std)", of_boxes=False,
    ),
    Cause(
        "detections_shifted", "place of the detections", TURNS[:2],
        "are alike all over the image: its detections seem to lie {size} px from where they belong, because "
        "of the detector, the principal point or a turn of the camera",
        f"look at where the detector puts its points, or {REFINE}", of_boxes=False,
    ),
    Cause(
        "pose_inaccurate", "pose", TURNS,
        "depend on the place in the image: its pose seems to be slightly off", REFINE, of_boxes=False,
    ),
)  # fmt: skip
# What all cameras may have alike.
EVERYWHERE = (
    LENS_MISSING,
    LENS_INACCURATE,
    Cause(
        "readout_missing", "shutter", (SHUTTER,),
        "follow the speed of the objects times the row: a rolling shutter seems to be missing, near readout_s = "
        "{value:.2g}", f"state readout_s, or {ESTIMATE_READOUT}",
    ),
)  # fmt: skip


def check_residuals(geometry: Geometry, stated: Mapping[str, Array] | None = None) -> Iterator[Finding]:
    """Yield a finding if the clock, shutter, lens or pose of a camera seems to be slightly off, else one for each pair.

    The middle of a box is not the image of one point of the object, which looks like an error of a pose: where
    detections are boxes no pose is called off. What lasts may be the `stated` noise, px, by camera: of errors that last
    for long one-camera tracks show less.
    """
    samples, noise = geometry.samples, [one.camera.detector.sigma for one in geometry.samples]
    larger = [((stated or {}).get(one.camera.name, own) / own).mean() for one, own in zip(samples, noise, strict=True)]
    motion = [track_motion(sample) for sample in samples]
    # a wide tolerance may be the best by chance
    reaches = [FARTHEST * (m.tolerance if m.score >= CHANCE_SCORE else TOLERANCES[0]) for m in geometry.given]
    pairs = [
        found for pair, reach in zip(geometry.pairs, reaches, strict=True)
        if (found := partners(samples, motion, pair.a, pair.b, reach))
    ]  # fmt: skip
    boxes = any(sample.box_height_px is not None for sample in samples)
    explained = _certain(samples, pairs)
    if explained is not None and not (boxes and not explained[0].cause.of_boxes):
        best = explained[0]
        concerned = (pair for pair in pairs if best.camera in (None, pair.a, pair.b))
        if not (best.leaves_what_lasts and any(_lasts(pair) for pair in concerned)):
            yield _named(samples, pairs, *explained)
            return
    for pair in pairs:
        names = f"{samples[pair.a].camera.name} and {samples[pair.b].camera.name}"
        mean, spread, count = float(pair.distance.mean()), float(pair.distance.std()), len(np.unique(pair.tracks))
        variance, lasts = pair.lasting[0], not boxes and _lasts(pair)
        text = (
            f"{names}: the rays of {count} pairs of tracks miss each other by {mean:+.2f} +- {spread:.2f} "
            f"standard deviations, {max(variance, 0.0) ** 0.5:.2f} of which last from frame to frame"
        )
        if lasts:
            apart = variance > max(1.0, min(larger[pair.a], larger[pair.b])) ** 2
            yield Finding(
                "geometry.residuals", "warning", f"{text}: poses, clocks or lenses seem to be off, none of them "
                "alone explains it, or the errors of detections last, as those of smoothed labels do, or of objects at "
                "rest in whole pixels; tracks are less certain than they state", round(spread, 3), 1.0, None,
                CHECK_CAMERAS if apart else LASTING_REMEDY, DO_NOT_MEET if apart else ERRORS_LAST,
            )  # fmt: skip
        elif lasts is None:
            text += f": of fewer than {LEAST_TRACKS} pairs of tracks this is not judged"
            yield Finding("geometry.residuals", "not checked", text, round(spread, 3), 1.0)
        else:
            yield Finding("geometry.residuals", "ok", text, round(spread, 3), 1.0)


def _lasts(pair: Partners) -> bool | None:
    """Return whether distances last from frame to frame; None if they do, of too few pairs of tracks to judge it."""
    variance, errors = pair.lasting
    if variance <= LASTING or errors <= LASTING_ERRORS:
        return False
    return len(np.unique(pair.tracks)) >= LEAST_TRACKS or None


def _certain(
    samples: list[CameraSample], pairs: list[Partners]
) -> tuple[CauseFit, list[CauseFit], list[CauseFit]] | None:
    """Return the simplest of the causes that explain most, those that explain as much, and all; None if none is."""
    # no shutter takes longer than a frame
    longest = max(sample.interval_s for sample in samples)
    fits = [
        fit for fit in explanations(samples, pairs)
        if fit.cause.numbers != (SHUTTER,) or abs(fit.value) <= longest
    ]  # fmt: skip
    if not any(fit.is_certain(FALSE_ALARMS / len(fits)) for fit in fits):
        return None
    most = max(fits, key=lambda fit: fit.explained)
    chance, all_numbers = ALIKE * (most.explained * most.left) ** 0.5, set(most.cause.numbers)
    # a cause that has all numbers of another explains the same with these: only the difference is by chance
    parts = [fit.camera == most.camera and set(fit.cause.numbers) < all_numbers for fit in fits]
    least = [most.explained - (0.5 if is_part else 1.0) * chance for is_part in parts]
    alike = [fit for fit, explained in zip(fits, least, strict=True) if fit.explained >= explained]
    return min(alike, key=lambda fit: (len(fit.cause.numbers), -fit.explained)), alike, fits


def _named(
    samples: list[CameraSample], pairs: list[Partners], best: CauseFit, alike: list[CauseFit], fits: list[CauseFit]
) -> Finding:
    """Return the finding that names the best of the causes and those that explain as much (see `_certain`)."""
    # of two cameras the log does not show which one
    cause, same = best.cause, [fit for fit in (fits if len(pairs) == 1 else alike) if fit.cause is best.cause]
    if CLOCK in cause.numbers:
        best = min(same, key=lambda fit: fit.value)
    # times are off by the opposite of what they lack
    value = -best.value if CLOCK in cause.numbers else best.value
    factor, name = 1.0 + value, samples[best.camera or 0].camera.name
    remedy, change = cause.remedy, None
    if cause.name == "clock_rate":
        remedy += f" {1.0 / factor:.5g} (clock.rate) and check its offset again"
        if len(pairs) > 1:
            rate, offset = best.numbers.tolist()
            change = clock_change(samples[best.camera or 0], offset - rate * _middle(pairs), 1.0 + rate)
    if cause.name == "clock_offset":
        remedy, change = shift_remedy(best.value), clock_change(samples[best.camera or 0], best.value)

    stating = [one.camera.name for one in samples if one.camera.lens.model != "none"]

    def names(of: list[CauseFit]) -> str:
        cameras = sorted({fit.camera for fit in of if fit.camera is not None})
        if not cameras and {fit.cause.name for fit in of} == {LENS_INACCURATE.name} and len(stating) < len(samples):
            return " and ".join(stating)
        return " or ".join(samples[camera].camera.name for camera in cameras) or "all cameras"

    others = [fit for fit in alike if not set(cause.numbers) <= set(fit.cause.numbers)]
    camera = name if best.camera is not None and len({fit.camera for fit in (*same, *others)}) == 1 else None
    if camera is not None:
        remedy = remedy.replace("NAME", camera)
        if cause is LENS_MISSING:
            change = f"cameras.{camera}.distortion={{model: radial, k1: {value:.3g}}}"
    what = " or ".join(dict.fromkeys(fit.cause.what for fit in others))
    instead = f"; the {what} of {names(others)} would explain as much" if others else ""
    # what all cameras have alike is one number, and no shift
    shift, error = (best.shift * samples[best.camera or 0].camera.detector.sigma.mean()).tolist()
    size = f"at least {shift:.2g} +- {error:.1g}"
    text = cause.text.format(value=value, factor=factor, size=size, name=name)
    return Finding(
        "geometry.residuals", "warning",
        f"{names(same)}: the distances of rays from those of other cameras {text} (this explains "
        f"{percent(best.share)} of their squares{instead}); tracks are less certain than they state",
        round(shift if cause.numbers[0] in TURNS else value, 5), 0.0,
        camera, remedy, cause.name, change,
    )  # fmt: skip


@dataclass(frozen=True)
class CauseFit:
    """How a cause explains the distances of a camera, or of all of them."""

    cause: Cause
    camera: int | None  # None: all of them
    parts: Array  # (k,): Sizes that fit best of independent parts of the shift, standard deviations of a detection
    variances: Array  # (k,): Of these
    freedom: Array  # (k,): Degrees of freedom of the variances
    looks: Array  # (k,): How many looks at pairs of tracks, of `LEAST_COMMON` detections each, decide a part
    explained: float  # Of the squared distances, predicted from other tracks
    share: float  # The same over all of them
    left: float  # Mean square of what is left
    numbers: Array  # Of the cause, in its order
    lasting: tuple[float, float]  # What lasts of the distances that it leaves: its share, and in errors of white noise

    @property
    def value(self) -> float:
        """The number of a cause that has one, or the first."""
        return float(self.numbers[0])

    @property
    def shift(self) -> Array:
        """Root mean square of the shift of pixels as far as it is more than chance, and its standard error."""
        parts = self.parts * (self.parts**2 > LEAST_SQUARE * self.variances)
        size = np.linalg.norm(parts)
        return np.array([size, np.sqrt(parts**2 @ self.variances) / max(size, 1e-12)])

    @property
    def leaves_what_lasts(self) -> bool:
        """Whether distances last without it too: errors of single objects look like a cause, and are none."""
        return self.lasting[0] > MOST_LEFT and self.lasting[1] > LASTING_ERRORS

    def is_certain(self, probability: float) -> bool:
        """Whether a part is further from 0 than chance and what is tolerated bring any with this probability.

        By Student's distribution, since the variances are themselves estimated. Nor may all looks that decide it be at
        tracks of different objects.
        """
        squares = self.parts**2 / (self.variances + TOLERATED**2)
        if self.explained <= 0.0 or squares.max(initial=0.0) < LEAST_SQUARE:
            return False
        from scipy.special import fdtri  # costly to import, and rarely needed

        is_far = squares > fdtri(1, self.freedom, 1.0 - probability / len(self.parts))
        return bool((is_far & (MOST_WRONG**self.looks < FALSE_ALARMS)).any())


def explanations(samples: list[CameraSample], pairs: list[Partners]) -> Iterator[CauseFit]:
    """Yield how each cause explains the distances: of each camera, and of all that state nothing."""
    cameras = [sample.camera for sample in samples]
    rows = [(pair, Shifts.of(pair, (cameras[pair.a], cameras[pair.b]), _middle(pairs))) for pair in pairs]
    rows = [row for row in rows if len(row[1][0].tracks)]
    for camera in range(len(samples)):
        if own := [each[pair.b == camera] for pair, each in rows if camera in (pair.a, pair.b)]:
            together = Regression.of(own)
            yield from (together.fit(cause, camera) for cause in CAUSES if _can_be(cause, cameras[camera : camera + 1]))
    if rows:
        together = Regression.of([both for _, (*_, both) in rows])
        yield from (together.fit(cause, None) for cause in EVERYWHERE if _can_be(cause, cameras))


def _middle(pairs: list[Partners]) -> float:
    """Return the time, s, since which rates of clocks count, the same in all pairs of a camera."""
    return float(pairs[0].times.mean())


def _can_be(cause: Cause, cameras: list[Camera]) -> bool:
    """Whether what these cameras state lets them have a cause, alike if they are several."""
    lenses, several = sum(camera.lens.model != "none" for camera in cameras), len(cameras) > 1
    if cause.numbers == (SHUTTER,):
        return not several or not any(camera.readout_s for camera in cameras)
    return {LENS: lenses == 0, STATED: lenses > several}.get(cause.numbers[0], True)


@dataclass(frozen=True)
class Shifts:
    """What each number of a camera changes, detection by detection of a pair of cameras."""

    slopes: Array  # (n, 10): Derivatives of the distance with respect to the numbers, and the distance
    squares: Array  # (9, 9): Products of the shifts, summed, variances of a detection
    tracks: Integers  # (n,): One-camera tracks
    following: Integers  # (n,): See `Partners`

    @property
    def before(self) -> Integers:
        """Rows that another follows."""
        return np.flatnonzero(self.following >= 0)

    @staticmethod
    def of(pair: Partners, cameras: tuple[Camera, Camera], middle: float) -> list[Shifts]:
        """Return the rows of both cameras of a pair, and of both alike; clocks are off by their offsets at `middle`, s.

        Of a camera it is what the distance becomes with another camera, since lenses bend too much for a slope.
        """
        (a, b), since = pair.sides, pair.times - middle
        stated = signed_distances(*cameras, a.places, b.places)
        # what moves while both look is where their rays meet: the mean of what both see of it knows its speed better
        ahead, behind = (
            signed_distances(*cameras, a.places + s * a.velocity, b.places - s * b.velocity) for s in (STEP_S, -STEP_S)
        )
        moved, tables, squares = (ahead - behind) / (4.0 * STEP_S), [], []
        for camera, motion, slope in zip(cameras, pair.sides, (moved, -moved), strict=True):
            tables.append(-slope[:, None] * _later(camera, motion.places, since))
            relative = shifts_of(camera, motion.places, motion.velocity, since) / camera.detector.sigma[:, None]
            squares.append(np.einsum("nai,naj->nij", relative, relative))
        usable = np.isfinite(np.column_stack([stated, *tables, *(one.sum(axis=2) for one in squares)])).all(axis=1)
        rows = np.where(usable, np.cumsum(usable) - 1, -1)
        following = np.where(pair.following >= 0, rows[pair.following], -1)[usable]
        found = []
        for chosen, table, square, side in (
            ((0,), tables[0], squares[0], a), ((1,), tables[1], squares[1], b),
            ((0, 1), tables[0] + tables[1], 0.5 * (squares[0] + squares[1]), a),
        ):  # fmt: skip
            others = (
                [_changed(camera, k, step) if c in chosen else camera for c, camera in enumerate(cameras)]
                for k, step in enumerate(STEPS)
            )
            changed = np.stack([signed_distances(one, two, a.places, b.places) for one, two in others], axis=1)
            slopes = np.nan_to_num((changed - stated[:, None]) / STEPS)  # beyond where a lens folds back
            rows_of = np.column_stack([slopes, table, pair.distance])[usable]
            found.append(Shifts(rows_of, square[usable].sum(axis=0), side.tracks[usable], following))
        return found


def shifts_of(camera: Camera, pixels: Array, velocity: Array, since: Array) -> Array:
    """Return how far pixels (n, 2) would have to be moved for each number of a camera, (n, 2, 9), px.

    These are turns about its axes, rad, the logarithm of the focal length, the first radial coefficient, by how much
    stronger the whole lens is than stated, and what its true times lack: of the offset of its clock and of the time
    that its shutter takes, s, and of the rate of its clock in the times `since` (n,) some moment, s. Velocities (n, 2)
    are px/s. A move of a camera looks much like a turn; what it differs by depends on the depth, and that on the noise
    whose distances are to be explained.
    """
    seen = [
        (camera.project(_changed(camera, k, step).unproject(pixels, np.ones(len(pixels)))) - pixels) / step
        for k, step in enumerate(STEPS)
    ]
    moved = -velocity[:, :, None] * _later(camera, pixels, since)[:, None]
    return np.concatenate([np.nan_to_num(np.stack(seen, axis=2)), moved], axis=2)


def _later(camera: Camera, pixels: Array, since: Array) -> Array:
    """Return how much later, s, clock, shutter and rate make the true times (n,) of pixels (n, 2), by one of each."""
    return np.column_stack([np.ones(len(since)), pixels[:, 1] / camera.height, since])


def _changed(camera: Camera, number: int, step: float) -> Camera:
    """Return a camera with another of the numbers of `shifts_of`; of its lens without it, or with one it has not."""
    pose = camera.pose
    if number == FOCAL:
        return replace(camera, fx=camera.fx * (1.0 + step), fy=camera.fy * (1.0 + step))
    if number in (LENS, STATED):
        return replace(camera, lens=Lens("radial", k1=step) if number == LENS else Lens())
    return posed(camera, rotation_from_vector(step * np.eye(3)[number]) @ pose.rotation, pose.center)


@dataclass(frozen=True)
class Regression:
    """Distances and their derivatives, as sums of products over one-camera tracks."""

    sums: Array  # (g, 10, 10)
    looks: Array  # (g,): Detections of each, over those that a pair of tracks needs
    squares: Array  # (9, 9): Mean products of shifts
    noise: float  # Mean square of the distances
    lasting: Array  # (10, 10): Sums of products of successive rows of pairs of tracks: 0 of white noise
    successive: int  # Number of these

    @staticmethod
    def of(rows: list[Shifts]) -> Regression:
        """Return the sums over rows of the same camera."""
        table = np.concatenate([one.slopes for one in rows])
        tracks = np.concatenate([one.tracks for one in rows])
        order = np.argsort(tracks, kind="stable")
        _, starts, counts = np.unique(tracks[order], return_index=True, return_counts=True)
        sums = np.stack([block.T @ block for block in np.split(table[order], starts[1:])])
        squares = np.sum([one.squares for one in rows], axis=0) / len(table)
        lasting = np.sum([one.slopes[one.before].T @ one.slopes[one.following[one.before]] for one in rows], axis=0)
        noise, successive = float((table[:, -1] ** 2).mean()), sum(len(one.before) for one in rows)
        return Regression(sums, counts / LEAST_COMMON, squares, noise, lasting, successive)

    def fit(self, cause: Cause, camera: int | None) -> CauseFit:
        """Fit the numbers of a cause; of several, the combinations that the data determine."""
        chosen, total = list(cause.numbers), self.sums.sum(axis=0)
        squares = self.squares[np.ix_(chosen, chosen)]
        # combinations that shift pixels by one deviation, independent of each other in white noise
        whole = np.linalg.inv(np.linalg.cholesky(squares + 1e-9 * np.diag(squares.diagonal() + 1e-9)))
        values, vectors = np.linalg.eigh(whole @ total[np.ix_(chosen, chosen)] @ whole.T)
        # determined is what is known better than the place of one detection
        kept = values > (self.noise if len(chosen) > 1 else 0.0)
        # of these combinations the sum of all products is one
        size = 1.0 / np.sqrt(values[kept])
        basis = whole.T @ vectors[:, kept] * size
        products = basis.T @ self.sums[:, chosen][:, :, chosen] @ basis
        pull = -(self.sums[:, chosen, -1] @ basis)
        numbers, groups = pull.sum(axis=0), len(self.sums)
        # what fits the other tracks
        rest = (1.0 + 1e-6) * np.eye(len(numbers)) - products
        others = np.linalg.solve(rest, (numbers - pull)[:, :, None])[:, :, 0]
        explained = float((2.0 * pull * others).sum() - np.einsum("gi,gij,gj", others, products, others))
        share = explained / max(float(total[-1, -1]), 1e-12)
        # few tracks may happen to agree more than the noise of their detections lets them
        away = others - numbers
        variances = np.maximum((away**2).sum(axis=0) * (groups - 1) / groups, self.noise)
        # only what exceeds that noise has so few degrees of freedom (B. L. Welch, 1947)
        freedom = max(groups - 1, 0.1) / np.maximum(1.0 - self.noise / variances, 1e-3) ** 2
        # few of many tracks may decide, as those far from the centre do of a lens: their effective number (Kish, 1965)
        looks = 1.0 / (np.diagonal(products, axis1=1, axis2=2) ** 2 / self.looks[:, None]).sum(axis=0)
        whole, left = np.append(basis @ numbers, 1.0), self.noise * (1.0 - share)
        lasting = float(whole @ self.lasting[np.ix_([*chosen, -1], [*chosen, -1])] @ whole)
        in_errors = lasting / max(left * self.successive**0.5, 1e-12)
        return CauseFit(
            cause, camera, size * numbers, size**2 * variances, freedom, looks, explained, share, left, whole[:-1],
            (lasting / max(float(self.lasting[-1, -1]), 1e-12), in_errors),
        )  # fmt: skip
