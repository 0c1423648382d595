"""How much of the distances of rays a small error of clock, lens or pose explains."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.pipeline.checks.geometry.rays import signed_distances
from stereophd.pipeline.checks.residuals.partners import Partners

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
    rotation = rotation_from_vector(change[:3]) @ pose.rotation
    center = pose.center + size * change[3:]
    return replace(camera, pose=Pose(rotation, center, pose.velocity, pose.rotation_rate, pose.time_s))
