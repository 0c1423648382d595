"""One-camera tracks that can show cameras: those that move, as slopes on the clocks of the prior mean."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.two_views.track_rays import RawTracks

# Tracks count that move by this many standard deviations of a detection, and are seen in this share of the frames.
LEAST_MOTION, LEAST_SEEN = 12.0, 0.5
# Detections of a track, at least, and tracks of a camera, at most: those of the most pieces.
LEAST_LENGTH, MOST_TRACKS = 6, 40
# Frames over which tracks are smoothed, at most, and as a part of a quadratic piece.
MOST_SMOOTHED, SMOOTHED_PART = 31, 2.0
# A quadratic piece fits its detections (root mean square) to this many pixels, or to this many standard deviations.
PIECE_TOLERANCE, PIECE_SIGMAS = 3.0, 1.25


@dataclass(frozen=True)
class SlopeTracks:
    """Tracks of moving objects: `tracks` has slopes in place of pixels, and times by the clocks of the prior mean."""

    tracks: RawTracks
    pieces: Array  # (k,): quadratic pieces that each track needs: how much it can tell
    durations: Array  # (k,): s
    intervals: Array  # (c,): median time from detection to detection of each camera, s; NaN without tracks
    focal: Array  # (c,): focal length by which slopes are made, px
    sigma: Array  # (c,): noise of a detection, px
    left_out: int  # tracks that stand still or are seen too rarely

    def of_camera(self, camera: int) -> Integers:
        """Return the tracks of a camera."""
        return np.flatnonzero(self.tracks.cameras == camera)

    def at(self, tracks: Integers, times: Array) -> Array:
        """Slopes (k, g, 2) of tracks at times (g,), s; NaN where they were not seen."""
        slopes, seen = self.tracks.at(np.repeat(tracks, len(times)), np.tile(times, len(tracks)))
        return np.where(seen[:, None], slopes, np.nan).reshape(len(tracks), len(times), 2)


def count_pieces(times: Array, pixels: Array, tolerance: float) -> int:
    """Return how many quadratic pieces a curve (n, 2) needs, one after the other as long as each fits."""

    def fits(first: int, last: int) -> bool:
        since = np.linspace(-1.0, 1.0, last - first) if last - first < 4 else times[first:last] - times[first]
        since = since / max(float(np.abs(since).max()), 1e-12)
        powers = np.stack([np.ones_like(since), since, since**2], axis=1)
        left = pixels[first:last] - powers @ np.linalg.lstsq(powers, pixels[first:last], rcond=None)[0]
        return float(np.sqrt((left**2).sum(axis=1).mean())) <= tolerance

    count, first, most = 0, 0, len(times)
    while first < most:
        good, length = min(3, most - first), 4
        while first + length < most and fits(first, first + length):
            good, length = length, 2 * length
        length = min(length, most - first)
        if length > good and fits(first, first + length):
            good = length
        while length - good > 1:
            middle = (good + length) // 2
            good, length = (middle, length) if fits(first, first + middle) else (good, middle)
        first, count = first + good, count + 1
    return count


def smoothed(times: Array, pixels: Array, window: int) -> Array:
    """Pixels (n, 2) of a track after quadratic fits over a window of frames about each; as they are if it is short."""
    window -= 1 - window % 2
    if window < 5:
        return pixels
    steps = np.linspace(times[0], times[-1], round(float((times[-1] - times[0]) / np.median(np.diff(times)))) + 1)
    if len(steps) < window:
        return pixels
    powers, half = np.vander(np.linspace(-1.0, 1.0, window), 3), window // 2
    fitted, out = powers @ np.linalg.pinv(powers), []  # of a window, by its pixels
    for axis in pixels.T:
        even = np.interp(steps, times, axis)
        first, last, inner = fitted[:half] @ even[:window], fitted[-half:] @ even[-window:], fitted[half]
        out.append(np.interp(times, steps, np.concatenate([first, np.convolve(even, inner, "valid"), last])))
    return np.column_stack(out)


def slope_tracks(cameras: Sequence[Camera], raw: RawTracks) -> SlopeTracks:
    """Keep the tracks that move, as slopes by the intrinsics, lenses and clocks of cameras."""
    kept: list[tuple[float, int]] = []
    sigma = np.array([float(camera.detector.sigma.max()) for camera in cameras])
    intervals = np.array([raw.interval_s(number) * camera.clock.rate for number, camera in enumerate(cameras)])
    for track, (a, b) in enumerate(raw.spans()):
        number = int(raw.cameras[track])
        seen = (b - a - 1) * intervals[number] / max((raw.log_times[b - 1] - raw.log_times[a]), 1e-12)
        moved = float(np.linalg.norm(np.ptp(raw.pixels[a:b], axis=0)))
        if b - a >= LEAST_LENGTH and moved >= LEAST_MOTION * sigma[number] and seen >= LEAST_SEEN:
            tolerance = max(PIECE_TOLERANCE, PIECE_SIGMAS * np.sqrt(2.0) * float(sigma[number]))
            kept.append((float(count_pieces(raw.log_times[a:b], raw.pixels[a:b], tolerance)), track))
    chosen = []
    for number in range(len(cameras)):
        of_camera = sorted((entry for entry in kept if raw.cameras[entry[1]] == number), key=lambda entry: -entry[0])
        chosen += sorted(of_camera[:MOST_TRACKS], key=lambda entry: entry[1])
    tracks = np.array([track for _, track in chosen], dtype=np.int64)
    spans = raw.spans(tracks)
    nothing = np.empty(0)
    slopes, times = [nothing.reshape(0, 2)], [nothing]
    pieces = np.array([count for count, _ in chosen])
    for track, (a, b), count in zip(tracks.tolist(), spans, pieces.tolist(), strict=True):
        camera = cameras[raw.cameras[track]]
        window = min(MOST_SMOOTHED, int((b - a) / (SMOOTHED_PART * count)))
        slopes.append(camera.rays(smoothed(raw.log_times[a:b], raw.pixels[a:b], window))[:, :2])
        times.append(camera.clock.to_true(raw.log_times[a:b]) + camera.readout_s * raw.rows[a:b])
    first = np.concatenate([[0], np.cumsum([b - a for a, b in spans])]).astype(np.int64)
    joined = RawTracks(raw.cameras[tracks], first, np.concatenate(times), np.concatenate(slopes), np.empty(0))
    durations = np.array([float(joined.log_times[b - 1] - joined.log_times[a]) for a, b in joined.spans()])
    focal = np.array([0.5 * (camera.fx + camera.fy) for camera in cameras])
    return SlopeTracks(joined, pieces, durations, intervals, focal, sigma, len(raw.cameras) - len(tracks))
