"""Pairs of one-camera tracks that may be one object, and the rays of both at their common times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.recording import Scans
from stereophd.core.calibration.pairing.association import track_detections
from stereophd.core.calibration.pairing.track_rays import LONGEST_GAP, RawTracks, rays_of
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.multi.pmb.filter import PmbFilter

# Times at which a pair of tracks is compared, and how many it needs.
PAIR_TIMES, LEAST_TIMES = 24, 6
# Times at which tracks of unknown clocks or lenses are compared, and reach of the clocks in standard deviations.
RAW_TIMES, REACH = 48, 4.0


@dataclass(frozen=True)
class TrackPairs:
    """Pairs of one-camera tracks, and the rays at their common times."""

    cameras: Integers  # (p, 2) of int: The two cameras of every pair
    tracks: Integers  # (p, 2) of int: The two tracks, numbered over all cameras
    pair: Integers  # (n,) of int: Pair of each row
    rays: Array  # (n, 2, 3): x_a, x_b with third component 1
    sigma: Array  # (n,): Noise, px
    times: Array  # (n,): s
    # `entries`, `others`: arrays (n,) of int: Entry of the first track in `raw`, and the second track.
    entries: Integers
    others: Integers
    # Where clocks, lenses or intrinsics are unknown, or cameras move: the rays depend on the cameras, and `rays` and
    # `times` are those of the prior mean.
    raw: RawTracks | None

    @cached_property
    def camera_pairs(self) -> list[tuple[int, int]]:
        """Each two cameras that have pairs, in order."""
        return [(int(i), int(j)) for i, j in np.unique(self.cameras, axis=0)]

    def take(self, members: Integers) -> TrackPairs:
        """Return some of the pairs, in increasing order, with their rows."""
        rows = np.flatnonzero(np.isin(self.pair, members))
        raw = self.raw is not None
        return TrackPairs(
            self.cameras[members],
            self.tracks[members],
            np.searchsorted(members, self.pair[rows]),
            self.rays[rows],
            self.sigma[rows],
            self.times[rows],
            self.entries[rows] if raw else self.entries,
            self.others[rows] if raw else self.others,
            self.raw,
        )


def one_camera_tracks(template: PmbFilter, scans: Scans, least: int) -> list[tuple[int, Integers]]:
    """Track each camera's detections by themselves: (camera, detections of the recording) of every long track."""
    out = []
    for camera in np.unique(scans.cameras).tolist():
        alone = scans.of_camera(camera)
        found = track_detections(template, alone, 1.0)
        for track in range(int(found.tracks.max()) + 1 if len(found) else 0):
            detections = alone.source[found.detections[found.tracks == track]]
            if len(detections) >= least:
                out.append((camera, detections))
    return out


def make_pairs(parameters: ParameterSet, scans: Scans, tracks: Sequence[tuple[int, Integers]]) -> TrackPairs:
    """Pair all tracks of different cameras that were seen at the same time, or may have been by unknown clocks."""
    moving = any(not camera.pose.is_static for camera in parameters.cameras)
    if parameters.only_poses and not moving:
        return _known_rays(parameters, scans, tracks)
    raw = RawTracks.of(scans.recording, tracks)
    spread = clock_spreads(parameters, raw)
    times = [parameters.cameras[c].clock.to_true(raw.log_times[a:b]) for c, a, b in _segments(raw)]
    members: list[tuple[int, int]] = []
    pair: list[Integers] = []
    entries: list[Integers] = []
    for a in range(len(tracks)):
        for b in range(len(tracks)):
            if raw.cameras[b] <= raw.cameras[a]:
                continue
            slack = REACH * np.hypot(spread[a], spread[b])
            both = np.flatnonzero((times[a] >= times[b][0] - slack) & (times[a] <= times[b][-1] + slack))
            if len(both) < LEAST_TIMES:
                continue
            some = both[np.unique(np.linspace(0, len(both) - 1, RAW_TIMES).astype(int))]
            pair.append(np.full(len(some), len(members)))
            members.append((a, b))
            entries.append(raw.first[a] + some)
    nothing = np.empty(0, dtype=np.int64)
    of_pair, all_entries = np.concatenate([nothing, *pair]), np.concatenate([nothing, *entries])
    pairs = np.array(members, dtype=np.int64).reshape(-1, 2)
    others = pairs[of_pair, 1]
    found = rays_of(parameters.cameras, raw, all_entries, others)
    detections = np.concatenate([nothing, *(rows for _, rows in tracks)])
    sigma = scans.recording.sigma[detections[all_entries], 0]
    cameras = raw.cameras[pairs].reshape(-1, 2)
    return TrackPairs(cameras, pairs, of_pair, found.rays, sigma, found.times, all_entries, others, raw)


def _segments(raw: RawTracks) -> Iterator[tuple[int, int, int]]:
    return zip(raw.cameras.tolist(), raw.first[:-1].tolist(), raw.first[1:].tolist(), strict=True)


def clock_spreads(parameters: ParameterSet, raw: RawTracks) -> Array:
    """Prior standard deviation (k,) of the true times of tracks, s."""
    by_name = dict(zip(parameters.names, parameters.prior_std.tolist(), strict=True))
    out = []
    for camera, first, last in _segments(raw):
        name = parameters.cameras[camera].name
        late = float(np.abs(raw.log_times[first:last]).max())
        out.append(np.hypot(by_name.get(f"{name}.clock_offset", 0.0), late * by_name.get(f"{name}.clock_rate", 0.0)))
    return np.array(out)


def _known_rays(parameters: ParameterSet, scans: Scans, tracks: Sequence[tuple[int, Integers]]) -> TrackPairs:
    """Pairs of tracks of cameras that stand still, the clocks, lenses and intrinsics of which are known."""
    cameras: list[tuple[int, int]] = []
    members: list[tuple[int, int]] = []
    pair: list[Integers] = []
    rays: list[Array] = []
    sigma: list[Array] = []
    at: list[Array] = []
    placed = [(camera, scans.places(detections)) for camera, detections in tracks]
    for a, (camera_a, rows_a) in enumerate(placed):
        for b, (camera_b, rows_b) in enumerate(placed):
            if camera_b <= camera_a:
                continue
            times_a, times_b = scans.detection_times[rows_a], scans.detection_times[rows_b]
            right = np.searchsorted(times_b, times_a).clip(1, len(times_b) - 1)
            gap = times_b[right] - times_b[right - 1]
            inside = (times_a >= times_b[0]) & (times_a <= times_b[-1])
            common = np.flatnonzero(inside & (gap <= LONGEST_GAP * float(np.median(np.diff(times_b)))))
            if len(common) < LEAST_TIMES:
                continue
            common = common[np.unique(np.linspace(0, len(common) - 1, PAIR_TIMES).astype(int))]
            pixels_b = np.column_stack(
                [np.interp(times_a[common], times_b, scans.points[rows_b, axis]) for axis in (0, 1)]
            )
            number = len(cameras)
            cameras.append((camera_a, camera_b))
            members.append((a, b))
            pair.append(np.full(len(common), number))
            both = [_rays(parameters, camera_a, scans.points[rows_a[common]]), _rays(parameters, camera_b, pixels_b)]
            rays.append(np.stack(both, axis=1))
            sigma.append(1.0 / np.sqrt(scans.precisions[rows_a[common], 0, 0]))
            at.append(times_a[common])
    return TrackPairs(
        np.array(cameras, dtype=np.int64).reshape(-1, 2),
        np.array(members, dtype=np.int64).reshape(-1, 2),
        np.concatenate([*pair, np.empty(0, dtype=np.int64)]).astype(np.int64),
        np.concatenate([*rays, np.empty((0, 2, 3))]),
        np.concatenate([*sigma, np.empty(0)]),
        np.concatenate([*at, np.empty(0)]),
        np.empty(0, dtype=np.int64),
        np.empty(0, dtype=np.int64),
        None,
    )


def _rays(parameters: ParameterSet, camera: int, pixels: Array) -> Array:
    c = parameters.cameras[camera]
    return np.column_stack([(pixels - [c.cx, c.cy]) / [c.fx, c.fy], np.ones(len(pixels))])
