"""Pairs of one-camera tracks that may be one object, and the rays of both at their common times."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.pairing.association import track_detections, with_depths
from stereophd.core.calibration.settings import AnnealedSettings
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.pmb.filter import PmbFilter
from stereophd.core.two_views.linking import linked
from stereophd.core.two_views.track_rays import RawTracks, Rays, rays_of

# Times at which a pair of tracks is compared, how many it needs, and reach of the clocks in standard deviations.
PAIR_TIMES, LEAST_TIMES, REACH = 48, 6, 4.0
# Largest distance in the image from the prediction of a track to its next detection, in heights of the image.
IMAGE_REACH = 1.0 / 12.0


@dataclass(frozen=True)
class TrackPairs:
    """Pairs of one-camera tracks, and the rays at their common times."""

    cameras: Integers  # (p, 2) of int: The two cameras of every pair
    tracks: Integers  # (p, 2) of int: The two tracks, numbered over all cameras
    pair: Integers  # (n,) of int: Pair of each row
    rays: Rays  # Of each row, by the cameras of the prior mean
    sigma: Array  # (n,): Noise, px
    # `entries`, `others`: arrays (n,) of int: Entry of the first track in `raw`, and the second track.
    entries: Integers
    others: Integers
    raw: RawTracks
    is_fixed: bool  # Whether the rays are the same for all values: clocks, lenses and intrinsics are known

    @cached_property
    def camera_pairs(self) -> list[tuple[int, int]]:
        """Each two cameras that have pairs, in order."""
        return [(int(i), int(j)) for i, j in np.unique(self.cameras, axis=0)]

    @cached_property
    def tables(self) -> list[Integers]:
        """Pairs (i, j) of the tracks of each two cameras, -1 where there is none."""
        out = []
        for two in self.camera_pairs:
            members = np.flatnonzero((self.cameras == two).all(axis=1))
            firsts, row = np.unique(self.tracks[members, 0], return_inverse=True)
            seconds, column = np.unique(self.tracks[members, 1], return_inverse=True)
            out.append(np.full((len(firsts), len(seconds)), -1))
            out[-1][row, column] = members
        return out

    def rays_of(self, cameras: Sequence[Camera], rows: Integers) -> Rays:
        """Return the rays of some rows by cameras."""
        if self.is_fixed:
            return self.rays.take(rows)
        return rays_of(cameras, self.raw, self.entries[rows], self.others[rows])

    def rows_of(self, members: Sequence[int] | Integers) -> Integers:
        """Return the rows of some of the pairs."""
        return np.flatnonzero(np.isin(self.pair, members))

    def take(self, members: Integers) -> "TrackPairs":
        """Return some of the pairs, in increasing order, with their rows."""
        rows = self.rows_of(members)
        return TrackPairs(
            self.cameras[members], self.tracks[members], np.searchsorted(members, self.pair[rows]),
            self.rays.take(rows), self.sigma[rows], self.entries[rows], self.others[rows], self.raw, self.is_fixed,
        )  # fmt: skip


def one_camera_tracks(
    template: PmbFilter, scans: Scans, settings: AnnealedSettings
) -> tuple[tuple[int, Integers], ...]:
    """Follow each camera's detections by themselves: (camera, detections of the recording) of the longer tracks.

    One camera does not show depths: where they drift, a track of the filter ends as soon as its depth is infinite.
    """
    out = []
    for camera in np.unique(scans.cameras).tolist():
        alone = scans.of_camera(camera)
        if settings.one_camera_tracks == "image":
            noise = 1.0 / np.sqrt(np.linalg.inv(alone.covariances)[:, 0, 0])
            reach = IMAGE_REACH * float(scans.recording.heights[camera])
            tracks = linked(alone.times, alone.first, alone.points, noise, reach)
        else:
            found = track_detections(with_depths(template, camera), alone, 1.0)
            tracks = [found.detections[found.tracks == track] for track in np.unique(found.tracks)]
        out += [(camera, alone.source[rows]) for rows in tracks if len(rows) >= settings.min_detections]
    return tuple(out)


def raw_tracks(recording: Recording, tracks: Sequence[tuple[int, Integers]]) -> RawTracks:
    """Collect the tracks of a recording: camera and detections of each."""
    detections = np.concatenate([np.empty(0, dtype=np.int64), *(rows for _, rows in tracks)])
    cameras = np.array([camera for camera, _ in tracks], dtype=np.int64)
    lengths = np.array([len(rows) for _, rows in tracks], dtype=np.int64)
    pixels = recording.pixels[detections]
    return RawTracks(
        cameras,
        np.concatenate([[0], np.cumsum(lengths)]),
        recording.log_times[recording.frame_of[detections]],
        pixels,
        pixels[:, 1] / np.repeat(recording.heights[cameras], lengths),
    )


def make_pairs(parameters: ParameterSet, scans: Scans, tracks: Sequence[tuple[int, Integers]]) -> TrackPairs:
    """Pair all tracks of different cameras that were seen at the same time, or may have been by unknown clocks."""
    raw = raw_tracks(scans.recording, tracks)
    spread = clock_spreads(parameters, raw)
    times = [
        parameters.cameras[c].clock.to_true(raw.log_times[a:b])
        for c, (a, b) in zip(raw.cameras.tolist(), raw.spans(), strict=True)
    ]
    nothing = np.empty(0, dtype=np.int64)
    members: list[tuple[int, int]] = []
    pair, entries = [nothing], [nothing]
    for a in range(len(tracks)):
        for b in np.flatnonzero(raw.cameras > raw.cameras[a]).tolist():
            slack = REACH * np.hypot(spread[a], spread[b])
            both = np.flatnonzero((times[a] >= times[b][0] - slack) & (times[a] <= times[b][-1] + slack))
            if len(both) < LEAST_TIMES:
                continue
            some = both[np.unique(np.linspace(0, len(both) - 1, PAIR_TIMES).astype(int))]
            pair.append(np.full(len(some), len(members)))
            members.append((a, b))
            entries.append(raw.first[a] + some)
    of_pair, all_entries = np.concatenate(pair), np.concatenate(entries)
    pairs = np.array(members, dtype=np.int64).reshape(-1, 2)
    others = pairs[of_pair, 1]
    rays = rays_of(parameters.cameras, raw, all_entries, others)
    detections = np.concatenate([nothing, *(rows for _, rows in tracks)])
    sigma = scans.recording.sigma[detections[all_entries], 0]
    cameras = raw.cameras[pairs].reshape(-1, 2)
    return TrackPairs(cameras, pairs, of_pair, rays, sigma, all_entries, others, raw, parameters.only_moves)


def clock_spreads(parameters: ParameterSet, raw: RawTracks) -> Array:
    """Prior standard deviation (k,) of the true times of tracks, s."""
    by_name = dict(zip(parameters.names, parameters.prior_std.tolist(), strict=True))
    out = []
    for camera, (first, last) in zip(raw.cameras.tolist(), raw.spans(), strict=True):
        name = parameters.cameras[camera].name
        late = float(np.abs(raw.log_times[first:last]).max())
        out.append(np.hypot(by_name.get(f"{name}.clock_offset", 0.0), late * by_name.get(f"{name}.clock_rate", 0.0)))
    return np.array(out)
