"""The acceleration of the objects, from the log-likelihood of the filter under one value after the other.

The value of greatest likelihood over the whole log (tuning by the innovations: Y. Bar-Shalom, X. R. Li and T.
Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4) describes the usual motion.
Real objects turn in short manoeuvres, which a log of mostly steady flight outvotes, and a track that does not follow
a manoeuvre costs more than one that settles late. Short windows of the log are therefore a sample of a population of
accelerations, whose distribution is that of greatest likelihood (N. Laird, "Nonparametric maximum likelihood estimation
of a mixing distribution", JASA 73, 1978), each given the windows before it. Where that is more probable than one value,
for so many shares (G. Schwarz, Annals of Statistics 6, 1978), the value is large enough for nearly all of it. Else it
is the top of the parabola through the likelihoods of the best values, whose curvature gives the standard error.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.config.loading import LoadedConfig, variant
from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.settings import ESTIMATE
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.pipeline.build import build_labelled_filter
from stereophd.pipeline.detectors.displacements import USUAL_RATIO, WIDER
from stereophd.pipeline.detectors.passes import stretches
from stereophd.pipeline.initial.template import rounded
from stereophd.pipeline.stream import open_stream
from stereophd.wording import LOGGER

# Fewest events that show an acceleration.
LEAST_EVENTS = 20
# Factor between neighbouring values, and their number in either direction from the first.
FACTOR, MOST_STEPS = 3.0, 8
# Log-likelihood that a smaller value must gain: where objects keep their velocity, it rises without end.
LEAST_GAIN = 2.0
# Events of a window, the share of the population whose manoeuvres may be left out, and the steps in which its
# distribution is found.
WINDOW, LEFT_OUT, STEPS = 25, 0.02, 500


@dataclass(frozen=True)
class AccelerationEstimate:
    """The acceleration that a log shows."""

    value: float  # `motion.acceleration_std`, length/s^2
    usual: float  # The value of greatest likelihood over all events
    error: float | None  # Standard error of the logarithm of that; None where the likelihood has no top
    tried: dict[float, float]  # Log-likelihood of every value, less that of `usual`
    events: int  # Events that the filter ran over for each value

    def report(self) -> dict[str, Any]:
        """Return the entry of ``report.json``."""
        tried = [{"acceleration_std": a, "log_likelihood": one} for a, one in sorted(self.tried.items())]
        return {
            "acceleration_std": self.value, "most_likely": self.usual, "relative_standard_error": self.error,
            "events": self.events, "tried": tried,
        }  # fmt: skip


def estimate_acceleration(
    loaded: LoadedConfig, parts: Sequence[Sequence[Event]], start: float, cameras: tuple[Camera, ...] | None = None
) -> AccelerationEstimate:
    """Return the acceleration of the objects, length/s^2, from stretches of a log and a starting value.

    The configuration has a filter for many objects; its own acceleration does not count, nor do its cameras if others
    are given.
    """
    found: dict[float, Array] = {}

    def likelihoods(value: float) -> Array:
        """Return the log-likelihood of every event."""
        if value not in found:
            stated = variant(loaded, [("estimate", {"motion.acceleration_std": value})])
            found[value] = log_likelihoods(stated, parts, cameras)
        return found[value]

    def climb(value: float, factor: float, least: float) -> float:
        """Follow a direction while it gains."""
        for _ in range(MOST_STEPS):
            following = rounded(value * factor)
            if likelihoods(following).sum() <= likelihoods(value).sum() + least:
                break
            value = following
        return value

    usual = climb(rounded(start), FACTOR, 0.0)
    if usual == rounded(start):
        usual = climb(usual, 1.0 / FACTOR, LEAST_GAIN)
    # where few objects turn and most rest there is a second peak far above, at which no track is lost
    high = rounded(getattr(loaded.config.motion, "max_speed", None) or start * FACTOR**3)
    if high > max(found) and likelihoods(max(found)).sum() < likelihoods(high).sum():
        peaks = [usual, *(climb(high, factor, 0.0) for factor in (FACTOR, 1.0 / FACTOR))]
        usual = max(peaks, key=lambda value: float(likelihoods(value).sum()))
    for factor in (FACTOR**0.5, FACTOR**-0.5):
        if likelihoods(rounded(usual * factor)).sum() > likelihoods(usual).sum() + LEAST_GAIN:
            usual = rounded(usual * factor)
            break
    near, best, error = sorted(found), usual, None
    if 0 < (place := near.index(usual)) < len(near) - 1:
        apart = np.log(near[place - 1 : place + 2]) - np.log(usual)
        bend, slope, _ = np.polyfit(apart, [likelihoods(value).sum() for value in near[place - 1 : place + 2]], 2)
        if bend < 0.0 and apart[0] < (top := -0.5 * slope / bend) < apart[2]:
            error = float((-2.0 * bend) ** -0.5)
            best = max(usual, rounded(usual * np.exp(top)), key=lambda value: float(likelihoods(value).sum()))
    for _ in range(MOST_STEPS):  # until it lies within the values tried, with its neighbours among them
        grid = {value: one for value, one in found.items() if value != best or value == usual}
        value = _of_windows(grid, found[best])
        if value is None or value <= usual:
            break
        missing = {rounded(value * FACTOR**power) for power in (-0.5, 0.5)} - found.keys()
        if value == max(found):
            missing = {rounded(value * FACTOR)}
        if not missing:
            break
        for neighbour in missing:
            likelihoods(neighbour)
    tried = {a: round(float((one - found[best]).sum()), 2) for a, one in found.items()}
    return AccelerationEstimate(max(best, value or 0.0), best, error, tried, sum(map(len, parts)))


def log_likelihoods(
    loaded: LoadedConfig, parts: Sequence[Sequence[Event]], cameras: tuple[Camera, ...] | None = None
) -> Array:
    """Return the log-likelihood of every event of stretches of a log, with the cameras of a configuration or these.

    What the filter forgets where tracks compete is added: it would outweigh what values and cameras differ by.
    """
    estimator = build_labelled_filter(loaded.config, cameras or loaded.build_cameras(), loaded.path, 1)
    found = []
    for part in parts:
        state = estimator.init()
        for event in part:
            state, info, _ = estimator.step(state, event.within(estimator.rig))
            found.append(info.log_likelihood + info.forgotten)
    return np.array(found)


def _of_windows(found: dict[float, Array], best: Array) -> float | None:
    """Return the least value that is enough for all but a few of the population that windows of the log show.

    None where the population is not more probable, for its shares, than one value, of `best` log-likelihoods (events,).
    """
    values = sorted(found)
    table = np.stack([found[value] - best for value in values])
    count = max(1, table.shape[1] // WINDOW)
    windows = np.stack([part.sum(axis=1) for part in np.array_split(table, count, axis=1)], axis=1)
    likelihood = np.exp(windows - (most := windows.max(axis=0)))
    shares = np.full(len(values), 1.0 / len(values))
    for _ in range(STEPS):
        joint = shares[:, None] * likelihood
        shares = (joint / joint.sum(axis=0)).mean(axis=1)
    if (np.log(shares @ likelihood) + most).sum() <= 0.5 * (len(values) - 1) * np.log(count):
        return None
    left_out = min(0.5, max(LEFT_OUT, 1.5 / count))  # whatever a single window shows
    return values[int((np.cumsum(shares) >= 1.0 - left_out).argmax())]


def with_estimated_motion(
    loaded: LoadedConfig, log_path: Path | str, cameras: tuple[Camera, ...] | None = None
) -> tuple[LoadedConfig, dict[str, Any] | None]:
    """Return a configuration with the acceleration that the log shows, and what to report of it.

    Calibrated cameras can take the place of those of the configuration, which comes back as it is without
    ``motion.acceleration_std: estimate``. Raises InputError if the filter is not one for many objects, or the log has
    too few frames.
    """
    config = loaded.config
    if getattr(config.motion, "acceleration_std", None) != ESTIMATE:
        return loaded, None
    if config.filter is None or isinstance(config.filter, SingleSettings):
        raise InputError(
            f"{loaded.path}: motion.acceleration_std: expected a number where filter.kind is not phd or pmb, found "
            f"{ESTIMATE}"
        )
    parts = [list(part) for part in stretches(open_stream(config, cameras or loaded.build_cameras(), log_path))]
    if sum(map(len, parts)) < LEAST_EVENTS:
        raise InputError(
            f"{log_path}: expected at least {LEAST_EVENTS} frames to estimate motion.acceleration_std from, found "
            f"{sum(map(len, parts))}; state a number"
        )
    start = USUAL_RATIO * float(np.max(config.filter.birth.velocity_std)) / WIDER
    estimate = estimate_acceleration(loaded, parts, start, cameras)
    LOGGER.info("%s: motion.acceleration_std estimated: %g", log_path, estimate.value)
    stated = variant(loaded, [("estimated from the log", {"motion.acceleration_std": estimate.value})])
    return stated, estimate.report()
