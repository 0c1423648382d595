"""Small errors of clock, lens and pose: rays meet, but their distances depend on speed or on the place in the image.

One-camera tracks of two cameras that meet most of the time belong to one object. The signed distance of their rays
from meeting, in standard deviations, is white noise of mean 0 if the set-up is right. An offset of a clock adds what
the object moves in that time, an error of a lens grows from the centre of the image, and an error of a pose is a smooth
function of the place. Each is fitted by itself; the one that explains most of the distances is named. Standard errors
follow from the spread between pairs of tracks, so that errors that last do not pass for evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.pipeline.checks.finding import Finding
from stereophd.pipeline.checks.rays import signed_distances
from stereophd.pipeline.checks.sample import CameraSample

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Detections of a camera that are examined, and candidates of all of them together.
MOST_DETECTIONS, MOST_PAIRS, LEAST_DETECTIONS = 3000, 200_000, 100
# Frames on either side from which an image velocity is fitted.
HALF_WINDOW = 4
# Largest distance of partners, standard deviations; frames, and share of a track, in which two tracks must meet.
FARTHEST, LEAST_COMMON, LEAST_SHARE = 6.0, 8, 0.5
# What a cause must explain of the squared distances, its size in standard deviations of a detection, and its size in
# standard errors.
LEAST_EXPLAINED, LEAST_EFFECT, LEAST_SCORE = 0.15, 0.4, 6.0
# The same of a pose, which has six numbers and therefore explains more of anything; and pairs of tracks it needs.
POSE_EXPLAINED, POSE_EFFECT, POSE_TRACKS = 0.3, 0.6, 8
# A cause with one number is preferred to a pose that explains less than this many times as much.
PREFERENCE = 1.35
# Cameras that explain this share of what the best one explains are named with it.
ALIKE = 0.97
CAUSES = {"clock": "clock_offset", "lens": "lens_inaccurate", "pose": "pose_inaccurate"}
# Steps of numerical derivatives: s, radians, and of k1.
STEP_S, STEP_ANGLE, STEP_K1 = 1e-3, 1e-6, 1e-5


@dataclass(frozen=True)
class Partners:
    """Detections of two cameras that belong to the same object.

    Attributes
    ----------
    a, b : int
        The cameras.
    pixels_a, pixels_b : array (n, 2)
        At the same times, those of B between its frames.
    velocity_b : array (n, 2)
        Image velocity of B's detections, px/s.
    distance : array (n,)
        Signed distance of the rays, standard deviations.
    tracks : array (n,) of int
        Number of the pair of one-camera tracks.
    """

    a: int
    b: int
    pixels_a: Array
    pixels_b: Array
    velocity_b: Array
    distance: Array
    tracks: Integers

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


@dataclass(frozen=True)
class CauseFit:
    """How much of the distances of a pair of cameras a cause explains.

    Attributes
    ----------
    value : float
        Of a cause with one number: s, or k1.
    error : float
        Its standard error, from the spread between pairs of tracks.
    explained : float
        Share of the squared distances.
    effect : float
        Root mean square of what is explained, standard deviations of a detection.
    """

    value: float
    error: float
    explained: float
    effect: float

    @property
    def is_decisive(self) -> bool:
        """Whether a cause with one number is beyond doubt, and large enough to matter."""
        return (
            self.explained >= LEAST_EXPLAINED
            and self.effect >= LEAST_EFFECT
            and abs(self.value) >= LEAST_SCORE * self.error
        )


@dataclass(frozen=True)
class PairFits:
    """How much each cause explains of the distances of a pair of cameras.

    Attributes
    ----------
    clock, lens_a, lens_b, pose : CauseFit
        An offset of B's clock; the first radial coefficient of A and of B; turns and shifts of B.
    """

    clock: CauseFit
    lens_a: CauseFit
    lens_b: CauseFit
    pose: CauseFit

    def of(self, cause: str) -> CauseFit:
        """Return the fit of a cause, of the better camera."""
        if cause == "lens":
            return max(self.lens_a, self.lens_b, key=lambda fit: fit.explained)
        return self.clock if cause == "clock" else self.pose

    def is_suspicious(self, tracks: int) -> bool:
        """Whether a cause explains the distances beyond doubt, given the number of pairs of tracks."""
        smooth = self.pose.explained >= POSE_EXPLAINED and self.pose.effect >= POSE_EFFECT
        return self.clock.is_decisive or self.of("lens").is_decisive or (smooth and tracks >= POSE_TRACKS)


def check_residuals(samples: list[CameraSample]) -> Iterator[Finding]:
    """Yield a finding if the clock, lens or pose of a camera seems to be slightly off, else one for each pair."""
    motion = [_track_velocities(sample) for sample in samples]
    pairs = [found for a, b in combinations(range(len(samples)), 2) if (found := partners(samples, motion, a, b))]
    fits = [explain(pair, samples[pair.a].camera, samples[pair.b].camera) for pair in pairs]
    suspicious = [(pair, fit) for pair, fit in zip(pairs, fits, strict=True) if fit.is_suspicious(pair.track_count)]
    if suspicious:
        yield _warning(samples, suspicious, list(zip(pairs, fits, strict=True)))
        return
    for pair in pairs:
        names = f"{samples[pair.a].camera.name} and {samples[pair.b].camera.name}"
        mean, spread = float(pair.distance.mean()), float(pair.distance.std())
        yield Finding(
            "geometry.residuals", "ok",
            f"{names}: the rays of {pair.track_count} pairs of tracks miss each other by {mean:+.2f} +- {spread:.2f} "
            f"standard deviations, correlation from frame to frame {pair.correlation:.2f}",
            round(spread, 3), 1.0,
        )  # fmt: skip


def _track_velocities(sample: CameraSample) -> tuple[Array, Integers]:
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
    interval = (np.searchsorted(second.times, times[chosen], side="right") - 1).clip(0, len(second.times) - 2)
    index = second.first[interval][:, None] + np.arange(width)
    present = index < second.first[interval + 1][:, None]
    index = np.where(present, index, 0)
    present &= (second.links[index] >= 0) & (track_b[index] >= 0)
    following = np.where(present, second.links[index], index)
    span = second.times[interval + 1] - second.times[interval]
    weight = ((times[chosen] - second.times[interval]) / np.where(span > 0.0, span, 1.0))[:, None, None]
    pixels_b = (1.0 - weight) * second.pixels[index] + weight * second.pixels[following]
    pixels_a = np.repeat(first.pixels[chosen], width, axis=0)
    found = signed_distances(first.camera, second.camera, pixels_a, pixels_b.reshape(-1, 2)).reshape(index.shape)
    found = np.where(present & np.isfinite(found), found, np.inf)
    rows = np.arange(len(chosen))
    best = np.abs(found).argmin(axis=1)
    near = np.abs(found[rows, best]) <= FARTHEST
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
    return PairFits(
        _fit(pair, slope(lambda s: between(first, second, pair.pixels_b + s * pair.velocity_b), STEP_S)),
        _fit(pair, slope(lambda k: between(_bent(first, k), second, pair.pixels_b), STEP_K1)),
        _fit(pair, slope(lambda k: between(first, _bent(second, k), pair.pixels_b), STEP_K1)),
        _fit_all(pair, np.stack(columns, axis=1)),
    )


def _fit_all(pair: Partners, design: Array) -> CauseFit:
    """CauseFit a cause with several numbers; those that the data do not determine (the scale) stay 0."""
    design = design / np.maximum(np.abs(design).max(axis=0), 1e-12)
    if not np.isfinite(design).all():
        return CauseFit(0.0, float("inf"), 0.0, 0.0)
    fitted = design @ np.linalg.lstsq(design, -pair.distance, rcond=1e-6)[0]
    total = float((pair.distance**2).sum())
    explained = 1.0 - float(((pair.distance + fitted) ** 2).sum()) / max(total, 1e-12)
    return CauseFit(0.0, float("inf"), explained, float(np.sqrt((fitted**2).mean())))


def _fit(pair: Partners, slope: Array) -> CauseFit:
    """CauseFit a cause with one number."""
    weight = float((slope**2).sum())
    if not np.isfinite(weight) or weight <= 0.0:
        return CauseFit(0.0, float("inf"), 0.0, 0.0)
    value = -float((slope * pair.distance).sum()) / weight
    left = pair.distance + value * slope
    spread = np.bincount(np.unique(pair.tracks, return_inverse=True)[1], slope * left)
    explained = 1.0 - float((left**2).sum()) / max(float((pair.distance**2).sum()), 1e-12)
    effect = abs(value) * np.sqrt(weight / len(slope))
    return CauseFit(value, float(np.sqrt((spread**2).sum())) / weight, explained, float(effect))


def _bent(camera: Camera, k1: float) -> Camera:
    """Return a camera with another first radial coefficient."""
    lens = camera.lens
    bent = Lens("radial", k1=k1) if lens.model == "none" else replace(lens, k1=lens.k1 + k1)
    return replace(camera, lens=bent)


def _moved(camera: Camera, component: int, step: float, size: float) -> Camera:
    """Return a camera turned about one of its axes (0 to 2), or moved along one of the world's (3 to 5)."""
    pose, change = camera.pose, np.zeros(6)
    change[component] = step
    rotation = rotation_from_vector(change[:3]) @ pose.rotation
    center = pose.center + size * change[3:]
    return replace(camera, pose=Pose(rotation, center, pose.velocity, pose.rotation_rate, pose.time_s))


def _warning(
    samples: list[CameraSample],
    suspicious: list[tuple[Partners, PairFits]],
    everything: list[tuple[Partners, PairFits]],
) -> Finding:
    """Return the finding that names the cause and the camera that explain most over all suspicious pairs."""
    totals: dict[tuple[str, int], float] = {}
    count = [sum(c in (pair.a, pair.b) for pair, _ in everything) for c in range(len(samples))]
    for pair, fits in suspicious:
        for camera, lens in ((pair.a, fits.lens_a), (pair.b, fits.lens_b)):
            for cause, explained in (
                ("clock", fits.clock.explained), ("lens", lens.explained), ("pose", fits.pose.explained / PREFERENCE),
            ):  # fmt: skip
                totals[cause, camera] = totals.get((cause, camera), 0.0) + explained / count[camera]
    (cause, _), best = max(totals.items(), key=lambda one: one[1])
    cameras = [c for (one, c), total in totals.items() if one == cause and total >= ALIKE * best]
    names = " or ".join(samples[c].camera.name for c in sorted(cameras))
    share = max(fits.of(cause).explained for _, fits in suspicious)
    text = f"{names}: the distances of its rays from those of other cameras"
    value: float = max(fits.of(cause).effect for _, fits in suspicious)
    if cause == "clock":
        late = _lateness(len(samples), everything)[cameras[0]]
        if len(cameras) > 1:  # of two cameras nobody knows which
            late = abs(late)
        text += f" follow the speed of the objects: its clock seems to be off by {late:+.3g} s"
        remedy, value = f"add {-late:.4g} s to its clock (clock.offset_s)", late
    elif cause == "lens":
        text += " grow from the centre of the image outwards: its lens coefficients seem to be off"
        remedy = "calibrate the lens again, or let calibrate estimate it (calibration.prior)"
    else:
        text += " depend on the place in the image: its pose seems to be slightly off"
        remedy = "let calibrate refine the poses, starting from these cameras"
    return Finding(
        "geometry.residuals", "warning", f"{text} (this explains {share:.0%} of their squares)", round(value, 5), 0.0,
        names if len(cameras) == 1 else None, remedy, CAUSES[cause],
    )  # fmt: skip


def _lateness(count: int, pairs: list[tuple[Partners, PairFits]]) -> Array:
    """Return by how much the times of each camera in the log are late (n,), s; the middle camera is right."""
    design = np.array([np.eye(count)[pair.b] - np.eye(count)[pair.a] for pair, _ in pairs])
    weight = np.array([1.0 / max(fits.clock.error, 1e-6) for _, fits in pairs])
    found = np.array([fits.clock.value for _, fits in pairs])
    late: Array = np.linalg.lstsq(design * weight[:, None], found * weight, rcond=1e-9)[0]
    return late - np.median(late) if count > 2 else 2.0 * late
