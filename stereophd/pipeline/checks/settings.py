"""Checks of the filter's settings against the objects that the log shows: depths, speeds, region.

Depths come from rays that meet, less what chance gives at other times and places. Speeds come from one-camera tracks at
these depths: across the line of sight, over windows of them, less what the noise of the detections gives.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from stereophd.config.model import Config
from stereophd.config.tracking import RegionConfig
from stereophd.core.arrays import Array
from stereophd.core.geometry.region import are_inside, half_spaces
from stereophd.core.motion.settings import ESTIMATE
from stereophd.core.single.settings import SingleSettings
from stereophd.pipeline.checks.finding import Finding
from stereophd.pipeline.checks.geometry.rays import LEAST_SCORE, TOLERANCES, Geometry, distances
from stereophd.pipeline.checks.log.sample import MOST_BY_CHANCE, CameraSample
from stereophd.validated import METRES
from stereophd.wording import number, percent, span

# Share of the depths that the region must cover, and the births, be it those of this first share of the time alone:
# objects move away from where they appear.
LEAST_COVERED, LEAST_BORN, BEGINNING = 0.6, 0.25, 0.25
# Share of the places that a box must hold: it may leave out most objects, such as spectators.
LEAST_INSIDE = 0.02
# Standard deviations of chance beyond which rays that meet inside it are those of objects.
CERTAIN = 2.0
# Factors by which a measured spread of the speed or acceleration is larger or smaller than stated: one that is a little
# too large does little harm.
LARGER, SMALLER = 6.0, 30.0
# Successive frames of a track, half of it where it is shorter, whose velocity is compared with that of the next ones:
# noise hides little in so many.
LEAST_WINDOW, WINDOW = 8, 16
# Share of the detections that one-camera tracks must hold before settings are called too large.
LEAST_HELD = 0.6
# Tracks that a speed is estimated from, and changes of velocity that an acceleration is, at least.
LEAST_TRACKS, LEAST_WINDOWS = 4, 6
# Speed of sound, m/s: what cameras follow is slower, but for bullets and meteors, and thousands of it are a wrong unit.
FASTEST = 340.0


@dataclass(frozen=True)
class MeasuredScene:
    """What the log shows of the objects."""

    depths: Array | None  # (3,) or None: Quantiles of 5, 50 and 95 % of the depth before the cameras, length
    depth_samples: Array  # (n,): Depths that represent the distribution, length
    first_depths: Array  # (n,): The same of the beginning of the log
    # (4,) or None: Root mean square of one component, and 95 % quantile of the speed across the line of sight,
    # length/s; and by how much a component changes in a second, at most, with what noise adds, and at least, NaN of
    # short tracks.
    speed: Array | None
    inside: float = np.nan  # Share of the places that lie in the half-spaces asked for; NaN where it holds objects


def measure_scene(
    geometry: Geometry, least_score: float = LEAST_SCORE, region: RegionConfig | None = None
) -> MeasuredScene:
    """Estimate depths and speeds of the objects, from pairs of cameras with at least this score."""
    spaces = half_spaces(region.packed()) if region is not None else np.empty((0, 4))
    samples, first, inside = _depth_samples(geometry, least_score, spaces)
    if not len(samples):
        return MeasuredScene(None, samples, samples, None)
    depths = np.quantile(samples, [0.05, 0.5, 0.95])
    chains = [sample for sample in geometry.samples if sample.linking[1] <= MOST_BY_CHANCE]
    return MeasuredScene(depths, samples, first, _speed(chains, float(depths[1])), inside)


def _speed(samples: list[CameraSample], depth: float) -> Array | None:
    """Return `speed` of a `MeasuredScene` at a depth; None where noise hides it."""
    squares, least, changes = [], [], [np.zeros(3)]
    for sample in samples:
        scale = depth / sample.camera.fx
        noise = scale * float(sample.camera.detector.sigma.mean())
        most = noise if sample.noise_px is None else max(noise, scale * sample.noise_px[2])
        places = depth * sample.camera.rays(sample.pixels)[:, :2]
        for track in sample.tracks:
            # what turns comes back: over all of a long track it hardly moves
            size = len(track) if len(track) < 2 * LEAST_WINDOW else min(len(track) // 2, WINDOW)
            windows = track[: len(track) // size * size].reshape(-1, size)
            with np.errstate(divide="ignore", invalid="ignore"):  # of one time
                velocities, shares, middles = _velocities(sample.times[sample.frame_of[windows]], places[windows])
                between, steps = np.diff(middles), np.diff(velocities, axis=0)
                # of what moves straight on the image moves along a line, faster or slower: what is across it shows
                # turns
                along = velocities[1:] + velocities[:-1]
                length = np.maximum(np.linalg.norm(along, axis=1), np.finfo(np.float64).tiny)
                across = (steps[:, 0] * along[:, 1] - steps[:, 1] * along[:, 0]) / length
                more = (across**2 - (shares[1:] + shares[:-1]) * most**2) / between
            if np.isfinite(velocities).all() and np.isfinite(more).all():
                square = (velocities**2).sum(axis=1)
                squares.append(float((square - 2.0 * shares * noise**2).mean()))
                least.append(np.maximum(np.sqrt(square) - 3.0 * np.sqrt(shares) * noise, 0.0))
                changes.append(np.array([len(between), ((steps**2).sum(axis=1) / between).sum(), more.sum()]))
    if len(squares) < LEAST_TRACKS or np.mean(squares) <= 2.0 * np.std(squares) / np.sqrt(len(squares)):
        return None
    count, changed, more = np.array(changes).T
    total = count.sum() if count.sum() >= LEAST_WINDOWS else np.nan
    certain = more.sum() / total - 3.0 * np.linalg.norm(more - count * more.sum() / total) / total
    change, least_change = np.sqrt([0.5 * changed.sum() / total, max(certain, 0.0)])
    return np.array([np.sqrt(np.mean(squares) / 2.0), np.quantile(np.concatenate(least), 0.95), change, least_change])


def _velocities(times: Array, places: Array) -> tuple[Array, Array, Array]:
    """Return velocities (n, 2) of places (n, k, 2) at times (n, k), their variances (n,) over that of a place, 1/s^2,
    and the middles (n,) of the times, s."""
    middle = times.mean(axis=1)
    since = times - middle[:, None]
    spread = (since**2).sum(axis=1)
    return np.einsum("nk,nka->na", since, places) / spread[:, None], 1.0 / spread, middle


def _depth_samples(geometry: Geometry, least_score: float, spaces: Array) -> tuple[Array, Array, float]:
    """Return 200 depths that represent the rays that meet, without those that meet by chance; and of the beginning.

    And the share of them that meet inside half-spaces (h, 4); NaN of no rays, and where it holds objects.
    """
    whole, first, inside = [], [], np.zeros(3)
    views = geometry.views
    for pair, given in zip(geometry.pairs, geometry.given, strict=True):
        a, b = views[pair.a], views[pair.b]
        apart = replace(pair.elsewhere(a.camera), pixels_b=pair.pixels_b[1:])
        measured = distances(replace(pair, pixels_b=pair.pixels_b[:1]), a, b), distances(apart, a, b)
        distance, depth = (np.concatenate(each) for each in zip(*measured, strict=True))
        meets = given.score >= least_score
        near = (np.abs(distance) <= (given.tolerance if meets else TOLERANCES[0])) & np.isfinite(depth) & (depth > 0.0)
        counts = near.sum(axis=(1, 2))
        spread = float(np.hypot(counts[1:].std(ddof=1), np.sqrt(max(counts[1:].mean(), 1.0))))
        # in a crowd every detection has a partner by chance, but not as many
        if meets or counts[0] - counts[1:].mean() >= least_score * spread:
            early = pair.times <= pair.times[0] + BEGINNING * np.ptp(pair.times)
            whole.append((depth[0][near[0]], depth[1:][near[1:]]))
            first.append((depth[0, early][near[0, early]], depth[1:, early][near[1:, early]]))
            if len(spaces):
                shift, row, _ = np.nonzero(near)
                pose, weights = a.camera.pose, np.where(shift == 0, 1.0, -1.0 / max(len(near) - 1, 1))
                places = pose.center + depth[near][:, None] * (a.rays(pair.pixels_a)[row] @ pose.rotation)
                held = weights[are_inside(places, spaces)]
                inside += held.sum(), -held[held < 0.0].sum(), weights.sum()
    shifts = max(1, geometry.pairs[0].pixels_b.shape[0] - 1) if geometry.pairs else 1
    share = float(inside[0] / inside[2]) if inside[2] > 0.0 else np.nan
    # a right region may be small beside what is around it: more than chance gives are objects, however few they are
    share = np.nan if inside[0] > CERTAIN * np.sqrt(1.0 + inside[1]) else share
    return _represent(whole, shifts), _represent(first, shifts), share


def _represent(found: list[tuple[Array, Array]], shifts: int) -> Array:
    """Return 200 depths that represent those found at the same time, less those by chance at so many other times."""
    if not sum(len(together) for together, _ in found):
        return np.empty(0)
    positive, negative = (np.concatenate(each) for each in zip(*found, strict=True))
    depths = np.concatenate([positive, negative])
    weights = np.concatenate([np.ones(len(positive)), np.full(len(negative), -1.0 / shifts)])
    order = np.argsort(depths)
    cumulative = np.maximum.accumulate(np.cumsum(weights[order]))
    if cumulative[-1] <= 0.0:
        return np.empty(0)
    places = np.searchsorted(cumulative, cumulative[-1] * (np.arange(200) + 0.5) / 200)
    return np.asarray(depths[order][np.minimum(places, len(depths) - 1)])


def expected_depths(config: Config | None, samples: list[CameraSample]) -> tuple[float, float]:
    """Return the depths between which the filter's births lie, length; a wide range where there are none."""
    if config is not None and config.filter is not None and not isinstance(config.filter, SingleSettings):
        birth = config.filter.birth
        if birth.depth_range is not None:
            return birth.depth_range
        if birth.disparity is not None:
            focal = samples[0].camera.fx * config.disparity.baseline
            high = birth.disparity.mean_px + 2.0 * birth.disparity.std_px
            low = max(birth.disparity.mean_px - 2.0 * birth.disparity.std_px, 0.1 * birth.disparity.mean_px)
            return focal / high, focal / low
    centres = np.array([sample.camera.pose.center for sample in samples])
    size = max(float(np.ptp(centres, axis=0).max()), 1e-3)
    return 0.5 * size, 20.0 * size


def check_settings(config: Config, scene: MeasuredScene, samples: list[CameraSample], whole: bool) -> list[Finding]:
    """Return findings about births, motion and region; objects are too slow for these only in a `whole` log."""
    settings, unit = config.filter, config.units.length
    if settings is None or isinstance(settings, SingleSettings) or scene.depths is None:
        return []
    held = np.mean([_held(sample) for sample in samples]) >= LEAST_HELD
    found = list(_speeds(config, scene, bool(whole and held)))
    if config.object.shape == "point":
        # boxes tell the depth of bodies
        found = [*_depths(config, scene, samples, unit), *_region(config, scene, unit), *found]
    causes = {one.cause for one in found}
    if {"depth_range", "velocity_std"} <= causes or "length_unit" in causes:
        # a unit is wrong, and settings that are adapted to it would hide that
        found = [replace(one, change=None) for one in found]
    return found


def _depths(config: Config, scene: MeasuredScene, samples: list[CameraSample], unit: str) -> Iterator[Finding]:
    """Yield whether births cover the depths at which rays meet."""
    assert scene.depths is not None
    low, high = expected_depths(config, samples)
    covered = max(
        float(((depths >= 0.8 * low) & (depths <= 1.25 * high)).sum()) / max(len(depths), 1)
        for depths in (scene.depth_samples, scene.first_depths)
    )
    where = f"between {number(scene.depths[0])} and {number(scene.depths[2])} {unit}"
    if covered < LEAST_BORN:
        near, far = 0.7 * scene.depths[0], 1.5 * scene.depths[2]
        key, change = "depth_range", f"[{near:.3g}, {far:.3g}]"
        if not (config.filter is None or isinstance(config.filter, SingleSettings)) and config.filter.birth.disparity:
            first, last = (samples[0].camera.fx * config.disparity.baseline / depth for depth in (near, far))
            key = "disparity"
            change = f"{{mean_px: {0.5 * (first + last):.3g}, std_px: {0.25 * (first - last):.3g}}}"
        yield Finding(
            "settings.depth_range", "warning",
            f"rays meet at depths {where}, but filter.birth covers {number(low)} to {number(high)} {unit}: it seems "
            "to be in another unit, or the centres of the cameras are",
            f"{low:.4g} to {high:.4g}", f"{scene.depths[0]:.4g} to {scene.depths[2]:.4g}", None,
            f"set filter.birth.{key} to these depths and some more", "depth_range", f"filter.birth.{key}={change}",
        )  # fmt: skip
    else:
        centers = np.array([sample.camera.pose.center for sample in samples])
        apart = np.linalg.norm(centers[:, None] - centers, axis=2)[np.triu_indices(len(centers), 1)]
        # the name of the unit leaves no trace in the data: only the user can tell
        size = f"the cameras are {span(apart.min(), apart.max(), 3)} {unit} apart"
        yield Finding("settings.depth_range", "ok", f"rays meet at depths {where}, {size}", round(covered, 3), 1.0)


def _held(sample: CameraSample) -> float:
    """Return the share of the detections that are not expected to be clutter which one-camera tracks hold."""
    expected = len(sample.pixels) - len(sample.times) * sample.camera.detector.clutter_per_frame
    return sum(map(len, sample.tracks)) / max(expected, 1.0)


def _region(config: Config, scene: MeasuredScene, unit: str) -> Iterator[Finding]:
    region = config.region
    if region is None or scene.depths is None:
        return
    remedy = "set region to where objects can be, in the unit of the configuration"
    if scene.inside < LEAST_INSIDE:
        yield Finding(
            "settings.region", "warning",
            f"{percent(max(scene.inside, 0.0))} of the rays that meet do so inside region.box or between the heights "
            "of region.polygon: nothing else is tracked", round(scene.inside, 3), LEAST_INSIDE, None,
            f"{remedy}, and region.polygon.up to the side where they are", "region",
        )  # fmt: skip
    if region.depth is None:
        return
    inside = float(((scene.depth_samples >= region.depth[0]) & (scene.depth_samples <= region.depth[1])).mean())
    if inside < LEAST_COVERED:
        yield Finding(
            "settings.region", "warning",
            f"rays meet at depths between {number(scene.depths[0])} and {number(scene.depths[2])} {unit}, outside "
            f"region.depth ({region.depth[0]:g} to {region.depth[1]:g} {unit})",
            round(inside, 3), 1.0, None, remedy, "region",
        )  # fmt: skip


def _speeds(config: Config, scene: MeasuredScene, complete: bool) -> Iterator[Finding]:
    """Yield findings about speeds; settings are too large only where the objects are `complete`."""
    settings, motion, unit = config.filter, config.motion, config.units.length
    assert settings is not None
    assert not isinstance(settings, SingleSettings)
    if scene.speed is None:
        return
    spread, fastest, change, least = scene.speed.tolist()
    stated = float(np.max(settings.birth.velocity_std))
    if spread > LARGER * stated or (complete and spread < stated / SMALLER):
        yield Finding(
            "settings.velocity_std", "warning",
            f"the objects move at about {number(spread)} {unit}/s per axis, but filter.birth.velocity_std is {stated:g}"
            ": it seems to be in another unit, or the times are",
            stated, round(spread, 6), None, f"set filter.birth.velocity_std near {1.5 * spread:.2g}", "velocity_std",
            f"filter.birth.velocity_std={1.5 * spread:.2g}",
        )  # fmt: skip
    if fastest * METRES.get(unit, 0.0) > FASTEST:
        yield Finding(
            "settings.length_unit", "warning",
            f"objects move at {number(fastest)} {unit}/s across the line of sight, faster than sound: the centres of "
            f"the cameras seem to be in a smaller unit than {unit}, or the times are wrong",
            round(fastest, 6), FASTEST / METRES[unit], None,
            "state the unit (units.length in the cameras, or import with `length_unit`), then run `init` again",
            "length_unit",
        )  # fmt: skip
    limit = getattr(motion, "max_speed", None)
    if limit is not None and limit < 0.8 * fastest:
        yield Finding(
            "settings.max_speed", "warning",
            f"objects move at up to {number(fastest)} {unit}/s across the line of sight, "
            f"but motion.max_speed is {limit:g}",
            limit, round(fastest, 6), None, f"set motion.max_speed to at least {2.0 * fastest:.2g}", "max_speed",
            f"motion.max_speed={2.0 * fastest:.2g}",
        )  # fmt: skip
    acceleration = getattr(motion, "acceleration_std", None)
    if acceleration in (None, ESTIMATE):
        return
    is_static = getattr(motion, "model", None) == "static"  # its acceleration is without effect, and not estimated
    most = 0.0 if is_static else float(np.max(acceleration))
    is_too_large = complete and most > SMALLER * change
    if is_too_large or least > LARGER * most:
        size, why = (f"about {number(change)}", "large") if is_too_large else (f"at least {number(least)}", "small")
        found = f"motion.acceleration_std is {most:g}: it is too {why}, or in another unit"
        yield Finding(
            "settings.acceleration_std", "warning",
            f"the velocity of the objects changes by {size} {unit}/s per axis in a second, but "
            f"{'motion.model is static' if is_static else found}", most, round(change, 6), None,
            "state a motion.model of objects that move" if is_static
            else "let track estimate it (motion.acceleration_std: estimate)",
            "acceleration_std", None if is_static else "motion.acceleration_std=estimate",
        )  # fmt: skip
