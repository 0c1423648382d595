"""A part of a log in memory, camera by camera, and the short one-camera tracks in it.

Checks look at raw pixels and at the times of frames, before any filter. A one-camera track is a chain of detections of
successive frames that are mutually nearest, within a gate that separates objects from clutter.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.two_views.linking import nearest_of_frame
from stereophd.io.logs.reading import Frame

# Frames of each camera that are kept; of those beyond the first of these, no more than have so many detections.
LEAST_FRAMES, MOST_FRAMES, MOST_DETECTIONS = 400, 3000, 60_000
# A frame with more than this many times the median number of detections, and more than as many as this, is a burst of
# clutter and not used to check the cameras.
BURST_SHARE, BURST_LEAST = 20, 1000
# Candidate gates of a link, px.
GATES_PX = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
# Standard deviations above chance from which steps beyond the gate are those of objects.
LEAST_SURE = 4.0
# Frames and detections in chains from which it is judged how often a chain goes on.
LEAST_CONTINUED_FRAMES, LEAST_CONTINUED = 8, 20
# Places in an image are distinguished to this many pixels; one lasts if it detects in so many frames and in this share
# of them, unless this share of all detections is at such places: then the scene rests.
PLACE_PX, LEAST_PLACE_FRAMES, LEAST_PLACE_SHARE, MOST_RESTING = 1.0, 60, 0.1, 0.5
# Different distances of neighbours along u, in parts of all detections, from which no two agree to the last digit by
# chance; pixels on a grid, of an image in another size too, have few.
LEAST_FINE = 0.2
# Standard deviations within which two detections of a frame may be of one object.
CLOSE = 6.0
# Differences from which noise is estimated, and the relative error of a variance from their median over the root of
# their number: they overlap.
LEAST_DIFFERENCES, VARIANCE_ERROR = 60, 3.5
# Least noise that one-camera tracks are taken to show, px: where objects turn hard they may show none.
LEAST_MEASURED_PX = 0.1
# Frames of the shortest track that counts, and the share of the links that chance may give: neighbours in a crowd of
# noisy detections leap, and lie nearer together than the noise.
LEAST_LENGTH, MOST_BY_CHANCE = 6, 1 / 3


@dataclass(frozen=True)
class CameraSample:
    """Frames of one camera."""

    camera: Camera
    times: Array  # (f,): True times of the frames (by the clock of the configuration), s, rising
    frames: Integers  # (f,) of int: Frame numbers
    first: Integers  # The detections of frame k are those from ``first[k]`` to ``first[k + 1]``
    pixels: Array  # (n, 2): Distorted pixels
    box_height_px: float | None = None  # Median height of the boxes whose middles these are; None of points

    def with_camera(self, camera: Camera) -> Self:
        """Return the frames with another description of their camera; their one-camera tracks stay."""
        other = replace(self, camera=camera)
        # the noise about them is measured along the axes of the detector
        other.__dict__.update({key: one for key, one in self.__dict__.items() if key not in ("camera", "noise_px")})
        return other

    def around(self, times: Array) -> tuple[Integers, Array]:
        """Return the frame before each time (n,), s, and the share of the span to the next that has passed by then."""
        interval = (np.searchsorted(self.times, times, side="right") - 1).clip(0, len(self.times) - 2)
        span = self.times[interval + 1] - self.times[interval]
        return interval, np.clip((times - self.times[interval]) / np.where(span > 0.0, span, 1.0), 0.0, 1.0)

    @property
    def with_noise_of_middles(self) -> Self:
        """The frames with the noise of the middles of boxes, which is a part of their height; unchanged of points."""
        if self.box_height_px is None:
            return self
        # imported here: it loads the kernels of bodies
        from stereophd.core.bodies.boxes import with_noise_of_middles

        return self.with_camera(with_noise_of_middles(self.camera, self.box_height_px))

    def with_measured_noise(self, only_less: bool = False) -> Self:
        """Return the frames with the noise about their one-camera tracks; unchanged where none shows.

        Wrong poses and clocks do not show in it, nor do errors that last, such as those of boxes. If `only_less`, a
        noise that is no larger than what their third differences leave room for stays: one that was estimated from
        residuals holds what poses, clocks and lenses add to them, and would hide it. The ratio of the axes stays.
        """
        sigma, measured = self.camera.detector.sigma, self.measured_noise_px
        stated = noise = float(sigma.mean())
        if self.noise_px is not None and measured is not None:
            noise = min(noise, max(self.noise_px[2], LEAST_MEASURED_PX)) if only_less else measured
        noise = max(noise, self.rounding_px)
        return self if noise == stated else self.with_camera(self.camera.with_noise(sigma * (noise / stated)))

    @cached_property
    def rounding_px(self) -> float:
        """The least noise of a detection, px: that of whole pixels, 0 where pixels have fractions, or are few."""
        is_whole = len(self.pixels) >= 20 and not ((self.pixels - self.pixels[0]) % 1.0).any()
        return 12.0**-0.5 if is_whole else 0.0

    @property
    def measured_noise_px(self) -> float | None:
        """The noise about one-camera tracks, px; None where none shows."""
        if self.box_height_px is not None or self.noise_px is None or self.linking[1] > MOST_BY_CHANCE:
            return None
        return max(self.noise_px[0], LEAST_MEASURED_PX)

    @property
    def detections_per_frame(self) -> float:
        """Mean number of detections of a frame."""
        return len(self.pixels) / max(1, len(self.times))

    @cached_property
    def interval_s(self) -> float:
        """Median interval between successive frames of different times, s; NaN without any."""
        steps = np.diff(self.times)
        return float(np.median(steps[steps > 0.0])) if steps.any() else float("nan")

    @cached_property
    def frame_of(self) -> Integers:
        """Frame of each detection (n,)."""
        return np.repeat(np.arange(len(self.times)), np.diff(self.first))

    @property
    def links(self) -> Integers:
        """Next detection of each detection's one-camera track (n,); -1 where the track ends."""
        return self.linking[0]

    @cached_property
    def linking(self) -> tuple[Integers, float]:
        """The `links`, and the share of them that frames which lie far apart have too."""
        following = np.full(len(self.pixels), -1, dtype=np.int64)
        first, second, near, _, by_chance = _gated(self, following < 0, following < 0)
        following[first[near]] = second[near]
        return following, by_chance

    @cached_property
    def reached(self) -> Booleans:
        """Whether a one-camera track leads to each detection (n,) from the frame before."""
        reached = np.zeros(len(self.pixels), dtype=np.bool_)
        reached[self.links[self.links >= 0]] = True
        return reached

    def carried(self, steps: int) -> tuple[Array, Array]:
        """Return where one-camera tracks are in every frame, and where so many frames later, both (f, *, 2).

        NaN where there are fewer. No step leads from every detection to itself.
        """
        first = last = np.arange(len(self.pixels))
        for _ in range(steps):
            going = self.links[last] >= 0
            first, last = first[going], self.links[last[going]]
        frames, count = self.frame_of[first], len(self.times)
        return by_interval(frames, self.pixels[first], count), by_interval(frames, self.pixels[last], count)

    @cached_property
    def alone(self) -> tuple[Array, Array]:
        """Detections of frames k and k + 1 that no one-camera track carries over, each (f - 1, *, 2), NaN for fewer."""
        intervals = len(self.times) - 1
        now = np.flatnonzero((self.links < 0) & (self.frame_of < intervals))
        later = np.flatnonzero(~self.reached & (self.frame_of > 0))
        return (
            by_interval(self.frame_of[now], self.pixels[now], intervals),
            by_interval(self.frame_of[later] - 1, self.pixels[later], intervals),
        )

    @cached_property
    def isolated_per_frame(self) -> float:
        """Detections of a frame in no chain, the median over twenty parts of the mean: it leaves out fast movements.

        Objects near one another that move far between frames leave the gate of a chain too, all the time. What they
        leave over in successive frames lies nearer together than in frames that lie far apart, unlike false detections,
        and is not isolated.
        """
        if not len(self.times):
            return 0.0
        alone = (self.links < 0) & ~self.reached & ~_leaping(self)
        parts = np.array_split(np.bincount(self.frame_of[alone], minlength=len(self.times)), 20)
        return float(np.median([part.mean() for part in parts if len(part)]))

    @cached_property
    def continued_share(self) -> float | None:
        """Share of the detections in a chain, before the last frame, that the next frame continues; None for few.

        That is the probability of detection where chains follow objects; far less where noise or motion outrun them.
        """
        asked = self.reached & (self.frame_of < len(self.times) - 1)
        if len(self.times) < LEAST_CONTINUED_FRAMES or asked.sum() < LEAST_CONTINUED:
            return None
        return float((self.links[asked] >= 0).mean())

    @property
    def close_share(self) -> float:
        """Share of the detections with another of their frame nearer than objects are distinguished, beyond chance.

        Every other detection of a frame is compared with those between: of many in one place, half are found. Chance
        is how many have one as near in a frame that lies far apart; what rests has as many there.
        """
        reach = CLOSE * min(float(self.camera.detector.sigma.mean()), self.noise_px[2] if self.noise_px else np.inf)
        asked = np.empty(len(self.pixels), dtype=np.bool_)
        # by their number in the frame, as those of frames that lie far apart
        numbers = np.arange(len(asked)) - self.first[self.frame_of]
        asked[np.lexsort((self.pixels[:, 0], self.frame_of))] = numbers % 2 == 0
        shares = [
            float((_nearest(self, step, asked, ~asked)[2] <= reach).sum())
            / max(1, int(asked[self.frame_of < len(self.times) - step].sum()))
            for step in (0, max(2, min(len(self.times) // 3, 200)))
        ]
        return shares[0] - shares[1]

    @property
    def repeated_share(self) -> float:
        """Share of the frames whose detections are all those of the frame before, to the last digit; 0 if by chance.

        Pixels of few digits and those of a scene at rest agree by chance.
        """
        counts, numbers = np.diff(self.first), np.arange(len(self.pixels))
        before = np.append(0, counts[:-1])[self.frame_of]
        own = counts[self.frame_of]
        alike = (before == own) & (self.pixels == self.pixels[numbers - own]).all(axis=1)
        repeated = (np.bincount(self.frame_of, alike, len(counts)) == counts) & (counts > 0)
        fresh = np.unique(self.pixels[~repeated[self.frame_of], 0])
        is_fine = len(np.unique(np.diff(fresh).round(9))) >= LEAST_FINE * len(self.pixels)
        return float(repeated.sum() / len(counts)) if is_fine and len(counts) else 0.0

    @property
    def lasting_places(self) -> list[tuple[Array, int]]:
        """Places (2,), px, that detect again and again, and in how many frames: the most frequent first.

        A dead pixel or a lamp is at one place to far less than a pixel, while objects move. Where most detections rest
        (a board, a scene of marks) there are none.
        """
        cells, number = np.unique(np.floor(self.pixels / PLACE_PX), axis=0, return_inverse=True)
        number = number.ravel()
        distinct = np.unique(number * len(self.times) + self.frame_of) // max(len(self.times), 1)
        frames = np.bincount(distinct, minlength=len(cells))
        least = max(LEAST_PLACE_FRAMES, LEAST_PLACE_SHARE * len(self.times))
        lasting = np.flatnonzero(frames >= least)
        if np.isin(number, lasting).sum() > MOST_RESTING * len(self.pixels):
            return []
        lasting = lasting[np.argsort(-frames[lasting], kind="stable")]
        return [(self.pixels[number == k].mean(axis=0), int(frames[k])) for k in lasting.tolist()]

    @cached_property
    def noise_px(self) -> tuple[float, float, float] | None:
        """Standard deviation of a detection about its track, px, the least and the largest; None where none shows.

        It is the mean of both axes, whose ratio is taken to be that of the detector. None shows without long tracks,
        and where most detections rest in whole pixels, which hide it.
        From third differences, which a steady acceleration does not change; the median resists wrong links. What white
        acceleration adds to their variance grows with the cube of the step, so that two steps tell it from noise. The
        least noise is three standard errors less; the largest is all that one step shows, and three more: swerves over
        more frames add more, so that nothing else is an upper bound.
        """
        once, twice = (self.third_differences(step) for step in (1, 2))
        if min(len(once), len(twice)) < LEAST_DIFFERENCES or np.median(np.abs(once)) == 0.0:
            return None
        # 1 + 9 + 9 + 1 = 20 times the variance of one detection
        single, double = (float(np.median(np.abs(each)) / 0.6745) ** 2 / 20.0 for each in (once, twice))
        error = VARIANCE_ERROR * np.hypot(8.0 * single / np.sqrt(len(once)), double / np.sqrt(len(twice)))
        value = max(8.0 * single - double, 0.0)
        largest = 7.0 * single * (1.0 + 3.0 * VARIANCE_ERROR / np.sqrt(len(once)))
        noise, least, most = np.sqrt(np.maximum([value, value - 3.0 * error, largest], 0.0) / 7.0).tolist()
        return noise, least, most

    def third_differences(self, step: int) -> Array:
        """Return third differences (n,), px, of one-camera tracks with even times, over steps of so many frames."""
        sigma, times = self.camera.detector.sigma, self.times[self.frame_of]
        pixels = self.pixels / (sigma / sigma.mean())
        even = [track for track in self.tracks if np.ptp(np.diff(times[track])) < 0.2 * self.interval_s]
        differences = [
            np.diff(pixels[track[first::step]], n=3, axis=0).ravel() for track in even for first in range(step)
        ]
        return np.concatenate(differences) if differences else np.empty(0)

    @cached_property
    def tracks(self) -> tuple[Integers, ...]:
        """Detections of every one-camera track of at least `LEAST_LENGTH` frames."""
        following = self.links
        starts = np.flatnonzero((following >= 0) & ~self.reached)
        found = []
        for start in starts.tolist():
            chain, k = [start], int(following[start])
            while k >= 0:
                chain.append(k)
                k = int(following[k])
            if len(chain) >= LEAST_LENGTH:
                found.append(np.array(chain, dtype=np.int64))
        return tuple(found)


def by_interval(intervals: Integers, pixels: Array, count: int) -> Array:
    """Return pixels (n, 2) in rows by their interval, (count, most, 2), NaN where a row has fewer; n in order."""
    sizes = np.bincount(intervals, minlength=count)
    table = np.full((count, max(1, int(sizes.max(initial=0))), 2), np.nan)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    table[intervals, np.arange(len(intervals)) - starts[intervals]] = pixels
    return table


def sample_log(frames: Iterable[Frame], cameras: tuple[Camera, ...]) -> list[CameraSample]:
    """Return the first frames of a log, so many a camera on average, fewer of a crowd; no more are read.

    The frames are in the order of true time. There is one sample per camera, in order; empty for one without frames.
    """
    kept: list[list[Frame]] = [[] for _ in cameras]
    detections = 0
    for count, frame in enumerate(frames, 1):
        kept[frame.camera].append(frame)
        detections += len(frame.pixels)
        is_crowded = detections >= MOST_DETECTIONS * len(cameras) and count >= LEAST_FRAMES * len(cameras)
        if is_crowded or count >= MOST_FRAMES * len(cameras):
            break
    return [_of_camera(camera, own) for camera, own in zip(cameras, kept, strict=True)]


def _of_camera(camera: Camera, frames: list[Frame]) -> CameraSample:
    counts = np.array([len(frame.pixels) for frame in frames], dtype=np.int64)
    most = max(BURST_LEAST, BURST_SHARE * float(np.median(counts))) if frames else 0.0
    frames, counts = [frame for frame in frames if len(frame.pixels) <= most], counts[counts <= most]
    heights = [frame.sizes[:, 1] for frame in frames if frame.sizes is not None and not np.isnan(frame.sizes).all()]
    return CameraSample(
        camera,
        np.array([frame.time_s for frame in frames], dtype=np.float64),
        np.array([frame.frame for frame in frames], dtype=np.int64),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.concatenate([frame.pixels for frame in frames]) if frames else np.empty((0, 2)),
        float(np.nanmedian(np.concatenate(heights))) if heights else None,
    )


def _nearest(sample: CameraSample, step: int, going: Booleans, coming: Booleans) -> tuple[Integers, Integers, Array]:
    """Return mutually nearest detections of frames k and k + step: first, second, distance in px.

    Among those (n,) of frame k that are `going` and those of frame k + step that are `coming`.
    """
    order = np.lexsort((sample.pixels[:, 0], sample.frame_of))
    pixels = np.ascontiguousarray(sample.pixels[order])
    following = nearest_of_frame(sample.first, pixels, step, going[order], coming[order])
    returned = nearest_of_frame(sample.first, pixels, -step, coming[order], going[order])
    first = np.flatnonzero((following >= 0) & (returned[following] == np.arange(len(order))))
    second = following[first]
    return order[first], order[second], np.hypot(*(pixels[second] - pixels[first]).T)


def _gated(
    sample: CameraSample, going: Booleans, coming: Booleans
) -> tuple[Integers, Integers, Booleans, float, float]:
    """Mutually nearest detections of successive frames, whether they lie within the best gate, and how sure that is.

    The gate is that which gains most over frames that lie far apart: by the fourth value, in standard deviations of
    what chance gives, and but for the share that is the last.
    """
    first, second, distances = _nearest(sample, 1, going, coming)
    if not len(first):
        return first, second, np.empty(0, dtype=np.bool_), 0.0, 1.0
    _, _, chance = _nearest(sample, max(2, min(len(sample.times) // 3, 200)), going, coming)
    expected = len(distances) / max(1, len(chance))
    by_chance = np.array([expected * np.count_nonzero(chance <= gate) for gate in GATES_PX])
    gains = np.array([np.count_nonzero(distances <= gate) for gate in GATES_PX]) - by_chance
    best = int(np.argmax(gains))
    # the expectation is itself a count, scaled
    sure = gains[best] / np.sqrt((1.0 + expected) * max(by_chance[best], 1.0))
    near = distances <= GATES_PX[best]
    return first, second, near, float(sure), float(by_chance[best] / max(np.count_nonzero(near), 1))


def _leaping(sample: CameraSample) -> Booleans:
    """Whether each detection (n,) has a step beyond the gate of the chains, among what the chains leave over."""
    leaps = np.zeros(len(sample.pixels), dtype=np.bool_)
    going, coming = sample.links < 0, ~sample.reached
    while True:
        first, second, near, sure, _ = _gated(sample, going, coming)
        if sure < LEAST_SURE:
            return leaps
        leaps[first[near]], leaps[second[near]] = True, True
        going[first[near]], coming[second[near]] = False, False
