"""Small errors of clock, lens and pose: rays meet, but their distances depend on speed or on the place in the image.

One-camera tracks of two cameras that meet most of the time belong to one object. The signed distance of their rays from
meeting, in standard deviations, is white noise of mean 0 if the set-up is right. An offset of a clock adds what the
object moves in that time, an error of a lens grows from the centre of the image, and an error of a pose is a smooth
function of the place. Each cause is fitted separately; the one that explains most of the distances is named. Standard
errors follow from the spread between pairs of tracks, so that errors that last do not pass for evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.pipeline.checks.finding import CHECK_CAMERAS, DO_NOT_MEET, Finding
from stereophd.pipeline.checks.geometry.alternatives import posed
from stereophd.pipeline.checks.geometry.causes import shift_remedy, shifted
from stereophd.pipeline.checks.geometry.rays import pairs_of, signed_distances
from stereophd.pipeline.checks.log.sample import CameraSample
from stereophd.wording import percent

# A cause with one number is preferred to a pose that explains less than this many times as much.
PREFERENCE = 1.35
# Cameras that explain this share of what the best one explains are named with it.
ALIKE = 0.97
# Lateness of one clock over that of a pair, from which it is what the pair shows.
LEAST_CHANGE = 0.5
# Root mean square of distances, standard deviations, and their correlation, from which a pair of cameras is wrong
# without a cause that explains it: that of chance is 3.5, as all distances are below `FARTHEST`.
LARGEST_DISTANCE, LARGEST_CORRELATION = 2.5, 0.6
ESTIMATE_LENS = "let calibrate estimate it (calibration.priors.NAME.distortion_std: {k1: 0.1})"
CAUSES = {
    "clock": "clock_offset", "lens": "lens_inaccurate", "lenses": "lens_missing", "pose": "pose_inaccurate",
}  # fmt: skip


def check_residuals(samples: list[CameraSample]) -> Iterator[Finding]:
    """Yield a finding if the clock, lens or pose of a camera seems to be slightly off, else one for each pair.

    The middle of a box is not the image of one point of the object, which looks like an error of a pose: where
    detections are boxes no pose is called off.
    """
    motion = [track_velocities(sample) for sample in samples]
    pairs = [found for a, b in pairs_of(len(samples)) if (found := partners(samples, motion, a, b))]
    fits = [explain(pair, samples[pair.a].camera, samples[pair.b].camera) for pair in pairs]
    together = list(zip(pairs, fits, strict=True))
    ignored = {"pose"} if any(sample.box_height_px is not None for sample in samples) else set()
    causes = [fit.decisive(pair.track_count) - ignored for pair, fit in together]
    suspicious = [both for both, decisive in zip(together, causes, strict=True) if decisive]
    if suspicious and (warning := _warning(samples, suspicious, together, set().union(*causes))) is not None:
        yield warning
        return
    for pair in pairs:
        names = f"{samples[pair.a].camera.name} and {samples[pair.b].camera.name}"
        mean, spread = float(pair.distance.mean()), float(pair.distance.std())
        text = (
            f"{names}: the rays of {pair.track_count} pairs of tracks miss each other by {mean:+.2f} +- {spread:.2f} "
            f"standard deviations, correlation from frame to frame {pair.correlation:.2f}"
        )
        lasts = np.hypot(mean, spread) > LARGEST_DISTANCE and pair.correlation > LARGEST_CORRELATION
        if lasts and pair.track_count >= POSE_TRACKS and not ignored:
            yield Finding(
                "geometry.residuals", "warning", f"{text}: poses, clocks or lenses seem to be off, none of them "
                "alone explains it, or the errors of detections last, as those of smoothed labels do",
                round(spread, 3), 1.0, None, CHECK_CAMERAS, DO_NOT_MEET,
            )  # fmt: skip
        else:
            yield Finding("geometry.residuals", "ok", text, round(spread, 3), 1.0)


def _warning(
    samples: list[CameraSample],
    suspicious: list[tuple[Partners, PairFits]],
    everything: list[tuple[Partners, PairFits]],
    decisive: set[str],
) -> Finding | None:
    """Return the finding that names the cause and the camera that explain most over all suspicious pairs.

    A cause is decisive for at least one pair, and undoing it must change something: pairs whose clocks contradict each
    other leave every clock as it is. None where no cause is left.
    """
    lateness = _lateness(len(samples), everything)
    totals: dict[tuple[str, int], float] = {}
    count = [sum(c in (pair.a, pair.b) for pair, _ in everything) for c in range(len(samples))]
    for pair, fits in suspicious:
        for camera, lens in ((pair.a, fits.lens_a), (pair.b, fits.lens_b)):
            for cause, explained in (
                ("clock", fits.clock.explained), ("lens", lens.explained), ("pose", fits.pose.explained / PREFERENCE),
            ):  # fmt: skip
                changes = cause != "clock" or abs(lateness[camera]) >= LEAST_CHANGE * abs(fits.clock.value)
                if cause not in decisive or not changes:
                    continue
                totals[cause, camera] = totals.get((cause, camera), 0.0) + explained / count[camera]
    joint = sum(fits.lenses.explained for _, fits in suspicious) if "lenses" in decisive else 0.0
    if not totals and not joint:
        return None
    (cause, camera), best = max(totals.items(), key=lambda one: one[1], default=(("lenses", 0), 0.0))
    cameras = [c for (one, c), total in totals.items() if one == cause and total >= ALIKE * best]
    names = " or ".join(samples[c].camera.name for c in sorted(cameras))
    if joint and joint >= ALIKE * best * count[camera]:
        # one camera explains no more of the pairs that it has than all together
        alone = f", or that of {names} alone" if ALIKE * joint <= best * count[camera] else ""
        cause, cameras, names = "lenses", [], f"all cameras that state no lens{alone}"
    share = max(fits.of(cause).explained for _, fits in suspicious)
    text = f"{names}: the distances of rays from those of other cameras"
    change, value = None, max(fits.of(cause).effect for _, fits in suspicious)
    if cause == "clock":
        # of two cameras the log does not show which one
        latest = cameras[0] if len(cameras) == 1 else max(cameras, key=lambda c: float(lateness[c]))
        late = float(lateness[latest])
        text += f" follow the speed of the objects: its clock seems to be off by {late:+.3g} s"
        remedy, value, change = shift_remedy(-late), late, shifted(samples[latest], -late)
    elif cause == "lens":
        text += " grow from the centre of the image outwards: its lens coefficients seem to be off"
        remedy = f"calibrate the lens again, or {ESTIMATE_LENS}"
    elif cause == "lenses":
        weights = np.array([1.0 / max(fits.lenses.error, 1e-9) ** 2 for _, fits in suspicious])
        value = float(weights @ [fits.lenses.value for _, fits in suspicious] / weights.sum())
        text += f" grow from the centre of the image outwards: the lens seems to be missing, near k1 = {value:.2g}"
        remedy = f"state the lens distortion, or {ESTIMATE_LENS}"
    else:
        text += " depend on the place in the image: its pose seems to be slightly off"
        remedy = "let calibrate refine the poses, starting from these cameras"
    return Finding(
        "geometry.residuals", "warning", f"{text} (this explains {percent(share)} of their squares)", round(value, 5),
        0.0, names if len(cameras) == 1 else None, remedy, CAUSES[cause], change,
    )  # fmt: skip


def _lateness(count: int, pairs: list[tuple[Partners, PairFits]]) -> Array:
    """Return by how much the times of each camera in the log are late (n,), s; the middle camera is right."""
    design = np.array([np.eye(count)[pair.b] - np.eye(count)[pair.a] for pair, _ in pairs])
    weight = np.array([1.0 / max(fits.clock.error, 1e-6) for _, fits in pairs])
    found = np.array([fits.clock.value for _, fits in pairs])
    late: Array = np.linalg.lstsq(design * weight[:, None], found * weight, rcond=1e-9)[0]
    return late - np.median(late) if count > 2 else 2.0 * late


# Least share of the squared distances that a cause must explain, its least size in standard deviations of a detection,
# and in standard errors.
LEAST_EXPLAINED, LEAST_EFFECT, LEAST_SCORE = 0.15, 0.4, 6.0
# The same for a pose, which has six numbers and therefore explains more of any distances; and pairs of tracks that it
# needs.
POSE_EXPLAINED, POSE_EFFECT, POSE_TRACKS = 0.3, 0.6, 8
# Parts of the time, each predicted from the others, and the least singular value over the largest of a
# number that these determine.
FOLDS, DETERMINED = 4, 1e-2
# Steps of numerical derivatives: s, radians, and of k1.
STEP_S, STEP_ANGLE, STEP_K1 = 1e-3, 1e-6, 1e-5


@dataclass(frozen=True)
class CauseFit:
    """How much of the distances of a pair of cameras a cause explains."""

    value: float  # The number of a cause that has one: s, or k1
    error: float  # Its standard error, from the spread between pairs of tracks
    explained: float  # Share of the squared distances, predicted from other parts of the time
    effect: float  # Root mean square of what is explained, standard deviations of a detection

    @property
    def is_decisive(self) -> bool:
        """Whether a cause with one number is beyond doubt, and large enough to matter."""
        return (
            self.explained >= LEAST_EXPLAINED
            and self.effect >= LEAST_EFFECT
            and abs(self.value) >= LEAST_SCORE * self.error
        )


# What cannot be asked explains nothing.
NO_FIT = CauseFit(0.0, float("inf"), 0.0, 0.0)


@dataclass(frozen=True)
class PairFits:
    """How much each cause explains of the distances of a pair of cameras."""

    # `clock`, `lens_a`, `lens_b`, `lenses`, `pose`: An offset of B's clock; the first radial coefficient of A, of B,
    # and of both where neither has a lens; turns and shifts of B.
    clock: CauseFit
    lens_a: CauseFit
    lens_b: CauseFit
    lenses: CauseFit
    pose: CauseFit

    def of(self, cause: str) -> CauseFit:
        """Return the fit of a cause, of the better camera."""
        if cause == "lens":
            return max(self.lens_a, self.lens_b, key=lambda fit: fit.explained)
        return {"clock": self.clock, "lenses": self.lenses, "pose": self.pose}[cause]

    def decisive(self, tracks: int) -> set[str]:
        """Return the causes that explain the distances beyond doubt, given the number of pairs of tracks."""
        smooth = self.pose.explained >= POSE_EXPLAINED and self.pose.effect >= POSE_EFFECT
        pose = {"pose"} if smooth and tracks >= POSE_TRACKS else set()
        return pose | {cause for cause in ("clock", "lens", "lenses") if self.of(cause).is_decisive}


def explain(pair: Partners, first: Camera, second: Camera) -> PairFits:
    """Return how much each cause explains of the distances of a pair."""

    def slope(change: Callable[[float], Array], step: float) -> Array:
        """Return the derivative of the distances by central differences."""
        return np.asarray((change(step) - change(-step)) / (2.0 * step))

    def between(a: Camera, b: Camera, pixels_b: Array) -> Array:
        return signed_distances(a, b, pair.pixels_a, pixels_b)

    size = float(np.linalg.norm(second.pose.center - first.pose.center))
    columns = [
        slope(lambda x, k=k: between(first, _moved(second, k, x, size), pair.pixels_b), STEP_ANGLE)  # type: ignore[misc]
        for k in range(6)
    ]
    both = _fit(pair, slope(lambda k: between(_bent(first, k), _bent(second, k), pair.pixels_b), STEP_K1))
    return PairFits(
        _fit(pair, slope(lambda s: between(first, second, pair.pixels_b + s * pair.velocity_b), STEP_S)),
        _fit(pair, slope(lambda k: between(_bent(first, k), second, pair.pixels_b), STEP_K1)),
        _fit(pair, slope(lambda k: between(first, _bent(second, k), pair.pixels_b), STEP_K1)),
        both if first.lens.model == second.lens.model == "none" else NO_FIT,
        _fit(pair, *columns),
    )


def _fit(pair: Partners, *slopes: Array) -> CauseFit:
    """Fit a cause with one number or several; those that the data do not determine (the scale) stay 0.

    What it explains of a part of the time is predicted from the others: two objects that pass each other's epipolar
    line meet smoothly for a while, which a fit to all of it would explain.
    """
    design = np.stack(slopes, axis=1)
    design = design / np.maximum(np.abs(design).max(axis=0), 1e-12)
    if not np.isfinite(design).all():
        return NO_FIT
    fold = np.arange(len(design)) * FOLDS // max(len(design), 1)
    fitted = np.zeros(len(design))
    for part in range(FOLDS):
        out = fold == part
        fitted[out] = design[out] @ np.linalg.lstsq(design[~out], -pair.distance[~out], rcond=DETERMINED)[0]
    total = float((pair.distance**2).sum())
    explained = 1.0 - float(((pair.distance + fitted) ** 2).sum()) / max(total, 1e-12)
    value, error = _number(pair, slopes[0], fold) if len(slopes) == 1 else (0.0, float("inf"))
    return CauseFit(value, error, explained, float(np.sqrt((fitted**2).mean())))


def _number(pair: Partners, slope: Array, fold: Integers) -> tuple[float, float]:
    """Return the number that fits all distances best, and its standard error.

    The error is that of the jackknife over pairs of tracks, in parts of the time: one pair of tracks that holds most of
    what the slope weighs is no evidence, whatever its own distances say (J. G. MacKinnon and H. White, "Some
    heteroskedasticity-consistent covariance matrix estimators", 1985).
    """
    weight = float((slope**2).sum())
    if weight <= 0.0:
        return 0.0, float("inf")
    value = -float((slope * pair.distance).sum()) / weight
    part = np.unique(pair.tracks * FOLDS + fold, return_inverse=True)[1]
    spread, share = np.bincount(part, slope * (pair.distance + value * slope)), np.bincount(part, slope**2) / weight
    return value, float(np.sqrt(((spread / np.maximum(1.0 - share, 1e-9)) ** 2).sum())) / weight


def _bent(camera: Camera, k1: float) -> Camera:
    """Return a camera with another first radial coefficient."""
    lens = camera.lens
    bent = Lens("radial", k1=k1) if lens.model == "none" else replace(lens, k1=lens.k1 + k1)
    return replace(camera, lens=bent)


def _moved(camera: Camera, component: int, step: float, size: float) -> Camera:
    """Return a camera turned about one of its axes (0 to 2), or moved along one of the world's (3 to 5)."""
    pose, change = camera.pose, np.zeros(6)
    change[component] = step
    return posed(camera, rotation_from_vector(change[:3]) @ pose.rotation, pose.center + size * change[3:])


# Detections of a camera that are examined, and candidates of all of them together.
MOST_DETECTIONS, MOST_PAIRS, LEAST_DETECTIONS = 3000, 200_000, 100
# Frames on either side from which an image velocity is fitted.
HALF_WINDOW = 4
# Largest distance of partners, standard deviations; frames, and share of a track, in which two tracks must meet.
FARTHEST, LEAST_COMMON, LEAST_SHARE = 6.0, 8, 0.5


@dataclass(frozen=True)
class Partners:
    """Detections of two cameras that belong to the same object."""

    # `a`, `b`: The cameras.
    a: int
    b: int
    # `pixels_a`, `pixels_b`: (n, 2): At the same times, those of B between its frames.
    pixels_a: Array
    pixels_b: Array
    velocity_b: Array  # (n, 2): Image velocity of B's detections, px/s
    distance: Array  # (n,): Signed distance of the rays, standard deviations
    tracks: Integers  # (n,) of int: Number of the pair of one-camera tracks

    @property
    def track_count(self) -> int:
        """Number of pairs of one-camera tracks."""
        return len(np.unique(self.tracks))

    @property
    def correlation(self) -> float:
        """Correlation of the distances in successive detections of a pair of tracks."""
        order = np.argsort(self.tracks, kind="stable")
        values, same = self.distance[order], np.diff(self.tracks[order]) == 0
        products = (values[1:] * values[:-1])[same]
        return float(products.mean() / max((values**2).mean(), 1e-12)) if len(products) else 0.0


def track_velocities(sample: CameraSample) -> tuple[Array, Integers]:
    """Return image velocities (n, 2), px/s, from lines through a few frames, and the track of each detection or -1."""
    velocity = np.full((len(sample.pixels), 2), np.nan)
    number = np.full(len(sample.pixels), -1, dtype=np.int64)
    for index, track in enumerate(sample.tracks):
        times = sample.times[sample.frame_of[track]]
        table = np.column_stack([times - times[0], sample.pixels[track]])
        places = np.arange(len(track))
        low, high = np.maximum(places - HALF_WINDOW, 0), np.minimum(places + HALF_WINDOW + 1, len(track))
        count = (high - low).astype(float)[:, None]

        def windowed(values: Array, low: Integers = low, high: Integers = high) -> Array:
            sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
            return np.asarray(sums[high] - sums[low])

        mean = windowed(table) / count
        products = windowed(table[:, :1] * table) - count * mean[:, :1] * mean
        velocity[track] = products[:, 1:] / np.maximum(products[:, :1], 1e-12)
        number[track] = index
    return velocity, number


def partners(samples: list[CameraSample], motion: list[tuple[Array, Integers]], a: int, b: int) -> Partners | None:
    """Return detections of A with those of B on one-camera tracks that meet them most of the time; None for few."""
    first, second = samples[a], samples[b]
    if len(second.times) < 4 or not len(first.pixels):
        return None
    times, track_a, (velocity, track_b) = first.times[first.frame_of], motion[a][1], motion[b]
    usable = np.flatnonzero((track_a >= 0) & (times >= second.times[0]) & (times <= second.times[-1]))
    width = int(np.diff(second.first).max(initial=0))
    most = min(MOST_DETECTIONS, max(LEAST_DETECTIONS, MOST_PAIRS // max(width, 1)), len(usable))
    if len(usable) < LEAST_DETECTIONS or not width:
        return None
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, most).astype(int))]
    interval, passed = second.around(times[chosen])
    index = second.first[interval][:, None] + np.arange(width)
    present = index < second.first[interval + 1][:, None]
    index = np.where(present, index, 0)
    present &= (second.links[index] >= 0) & (track_b[index] >= 0)
    following = np.where(present, second.links[index], index)
    weight = passed[:, None, None]
    pixels_b = (1.0 - weight) * second.pixels[index] + weight * second.pixels[following]
    pixels_a = np.repeat(first.pixels[chosen], width, axis=0)
    found = signed_distances(first.camera, second.camera, pixels_a, pixels_b.reshape(-1, 2)).reshape(index.shape)
    found = np.where(present & np.isfinite(found), found, np.inf)
    rows = np.arange(len(chosen))
    best = np.abs(found).argmin(axis=1)
    near = np.abs(found[rows, best]) <= FARTHEST
    near &= _nearest_of_frame(first.frame_of[chosen], index[rows, best], np.abs(found[rows, best]))
    index, following = index[rows, best], following[rows, best]
    lasting, tracks = _lasting(track_a[chosen][near], track_b[index][near])
    if lasting.sum() < LEAST_DETECTIONS:
        return None
    speed = (0.5 * (velocity[index] + velocity[following]))[near][lasting]
    own, other = first.pixels[chosen][near][lasting], pixels_b[rows, best][near][lasting]
    distance = found[rows, best][near][lasting]
    delay = _delays(first.camera, own) - _delays(second.camera, other)
    if delay.any():  # rolling shutters: from the times of frames to those of rows
        other = other + speed * delay[:, None]
        distance = signed_distances(first.camera, second.camera, own, other)
    return Partners(a, b, own, other, speed, distance, tracks[lasting])


def _nearest_of_frame(frames: Integers, others: Integers, distances: Array) -> NDArray[np.bool_]:
    """Return which detections (n,) of these frames are nearest to their partner of all that have the same."""
    order = np.lexsort((distances, others, frames))
    repeated = (np.diff(frames[order], prepend=-1) == 0) & (np.diff(others[order], prepend=-1) == 0)
    nearest = np.empty(len(frames), dtype=np.bool_)
    nearest[order] = ~repeated
    return nearest


def _delays(camera: Camera, pixels: Array) -> Array:
    """Return how long after its frame each detection (n,) was made, s."""
    delays = camera.row_delays(pixels[:, 1])
    return np.zeros(len(pixels)) if delays is None else delays


def _lasting(track_a: Integers, track_b: Integers) -> tuple[NDArray[np.bool_], Integers]:
    """Return which partners belong to tracks that meet most of the time, and the number of each pair of tracks."""
    _, number, count = np.unique(np.stack([track_a, track_b]), axis=1, return_inverse=True, return_counts=True)
    _, own, total = np.unique(track_a, return_inverse=True, return_counts=True)
    number = number.ravel()
    return (count[number] >= LEAST_COMMON) & (count[number] >= LEAST_SHARE * total[own]), number
