"""Two tracks that are paired crosswise: a test that swaps the detections of one camera between them (ours).

Two objects in one epipolar plane of two cameras have two explanations: the detections of the one camera may be paired
with those of the other in two ways, and the wrong way gives two objects as well, at other depths. The tracks of the PMB
filter are independent. Once both have settled on the wrong way, no track alone can leave it: the alternative of each
needs detections that the other claims, and a product of two small marginals falls as fast as the joint odds rise.

The decision is therefore taken for both tracks together, from the detections that they claimed in the last events:
both are filtered once more from their first kept detection on, as they are and with the detections of one camera
swapped. The detections are the same, and so is the prior of a new object, so that the difference of the
log-likelihoods is the logarithm of the odds of the two explanations (misses and clutter are the same in both). Where
the swap is ahead by more than a threshold, the tracks take its Gaussians, and their kept detections are swapped.
Track swaps that remain in a whole run are decided in `core.trajectories.swaps`.

The cost is bounded: only pairs in one epipolar plane are tested, of which both crosswise intersections lie before the
cameras (`core.multi.swaps.epipolar_pairs`); both explanations are followed from the last detections backwards, and
given up once the swap is `LATEST` nats behind; a pair that is far from a swap is left alone for a while; at
most `MOST_TESTS` an event.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Rig
from stereophd.core.disparity.rolling import NO_READINGS
from stereophd.core.disparity.sample_move import Draws
from stereophd.core.disparity.world_moments import place_in_world
from stereophd.core.motion.base import Motion
from stereophd.core.multi.filter_settings.common import BirthPrior
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.core.multi.swaps.epipolar_pairs import COPLANAR_SIGMAS, NewObjects, Past
from stereophd.core.multi.swaps.explanations import ExplainedRows, explain_rows, make_paths, room_for_explained
from stereophd.core.multi.swaps.history import ClaimedRows, History

# Fewest kept detections of each track in the camera whose detections are swapped, and in all others together.
LEAST_DETECTIONS = 3
# Most pairs that one event tests. With hundreds of objects, a pair is due at almost every event.
MOST_TESTS = 1
# Events until a pair is tested again: SOONEST, and one more for each nat by which the swap is behind, up to LATEST.
SOONEST, LATEST = 2, 64.0
# Events that a test looks at first: most often the last ones decide against a swap.
RECENT = 20
# Fewest samples in view for the fit of a Gaussian. Few are enough: a detection shows that the track is in view.
FEWEST = 2


@dataclass(frozen=True)
class SwapTest:
    """The test, and what it takes of a filter."""

    rig: Rig
    motion: Motion
    samples: Array  # (rows, s): Samples of the moves
    birth: BirthPrior
    threshold: float  # Log-odds above which detections are swapped

    @cached_property
    def tolerances(self) -> list[float]:
        """Distance of epipolar lines, px, in each camera."""
        return [COPLANAR_SIGMAS * float(np.max(one.detector.sigma)) for one in self.rig.cameras]

    @cached_property
    def _acceleration_std(self) -> float:
        return float(self.motion.noise_std.max())

    @cached_property
    def _draws(self) -> Draws:
        return Draws(self.samples, np.ones(self.samples.shape[1]), FEWEST)

    @cached_property
    def _prior_at_rest(self) -> NewObjects:
        return self.prior(self.rig.packed)

    def prior(self, views: Array) -> NewObjects:
        """Return the prior of new objects in each camera."""
        means, stds = np.array([self.birth.disparity_moments(view) for view in views]).T
        region = np.empty(0) if self.rig.region is None else self.rig.region
        return NewObjects(means.copy(), stds.copy(), float(self.birth.velocity_std), region)

    def compile(self) -> None:
        """Compile the kernels of the test of a pair, with one detection."""
        one = np.zeros(1, dtype=np.int64)
        prior = self.prior(self.rig.views(0.0))
        self.filter_again(ClaimedRows(one, np.zeros(1), one, np.zeros((1, 2)), np.eye(2)[None], NO_READINGS), prior)

    def search(self, history: History, camera: int, time_s: float, event: int) -> tuple[Any, Past]:
        """Return parameters of `swap_candidates` after an event of a camera, and the past where it is to be added.

        The camera is the one whose detections are swapped, with each camera before it in turn.
        """
        views, sightings = self.rig.views(time_s), history.sightings
        prior = self.prior(views) if self.rig.moving else self._prior_at_rest
        cameras, tolerance = (event // len(self.rig.cameras) % max(camera, 1), camera), self.tolerances[camera]
        past, longer = (
            Past(time_s - sightings[-count:][0].time_s if sightings else 0.0, self._acceleration_std)
            for count in (RECENT, RECENT - 1)
        )
        return (cameras, views, prior, tolerance, past, history.deferred, event, MOST_TESTS), longer

    def swap(
        self, mixture: GaussianMixture, history: History, pairs: Integers, camera: int, time_s: float, event: int
    ) -> tuple[GaussianMixture, History]:
        """Return a mixture and the history with swaps of those of the pairs that are paired crosswise."""
        prior = self.prior(self.rig.views(time_s)) if self.rig.moving else self._prior_at_rest
        deferred = history.deferred.after(event)
        for first, second in pairs.tolist():
            odds, swapped = self.explain(history, first, second, camera, prior)
            if swapped is not None:
                turned = self._is_nearer_turned(mixture, (first, second), swapped, time_s)
                mixture = _replaced(mixture, first, second, swapped[::-1] if turned else swapped)
                history = history.swapped(first, second, camera, others=turned)
            behind = abs(odds) if swapped is not None else max(-odds, 0.0)
            deferred = deferred.add((first, second, camera), event + SOONEST + round(min(behind, LATEST)))
        return mixture, replace(history, deferred=deferred)

    def _is_nearer_turned(
        self, mixture: GaussianMixture, labels: tuple[int, int], tracks: tuple[Track, Track], time_s: float
    ) -> bool:
        """Whether two labels stay nearer to where they are if each takes the other's track.

        A ghost shares a ray with both objects, and either may continue its identity.
        """
        heads = [int(np.flatnonzero(mixture.labels == label)[0]) for label in labels]
        homes = self.rig.spaces(mixture.cameras[heads], mixture.times[heads])
        places_now = [
            _place(mixture.means[k], home, time_s - mixture.times[k]) for k, home in zip(heads, homes, strict=True)
        ]
        places_swapped = [
            _place(one.mean, self.rig.space(one.camera, one.time_s), time_s - one.time_s) for one in tracks
        ]
        moves = np.linalg.norm(np.array(places_now)[:, None] - np.array(places_swapped), axis=2)
        return bool(moves[0, 1] + moves[1, 0] < moves[0, 0] + moves[1, 1])

    def explain(
        self, history: History, first: int, second: int, camera: int, prior: NewObjects
    ) -> tuple[float, tuple[Track, Track] | None]:
        """Return by how many nats two tracks explain their detections better with those of a camera swapped.

        With it both tracks after a swap that is ahead by more than the threshold; 0 where too little is known, and
        some number below ``-LATEST`` for all swaps that are further behind.
        """
        if len(history.sightings) > RECENT:
            odds, _ = self._compare(history.rows_of(first, second, RECENT), first, camera, prior)
            if odds < -LATEST:
                return odds, None
        return self._compare(history.rows_of(first, second), first, camera, prior)

    def _compare(
        self, rows: ClaimedRows, first: int, camera: int, prior: NewObjects
    ) -> tuple[float, tuple[Track, Track] | None]:
        """`explain` for all detections of two labels, of which one is the `first`."""
        of_camera, of_second = rows.cameras == camera, rows.labels != first
        for mine in (~of_second, of_second):
            if min(np.count_nonzero(mine & of_camera), np.count_nonzero(mine & ~of_camera)) < LEAST_DETECTIONS:
                return 0.0, None
        # backwards: what a label claimed last is most probably its own
        back = np.arange(len(rows.labels))[::-1]
        rows, of_second, of_camera = rows.take(back), of_second[back], of_camera[back]
        owners = np.stack([of_second, of_second ^ of_camera]).astype(np.int64)
        explained = self._explain(rows, owners, prior)
        # as Python's floats: infinities of both give NaN, without a warning of NumPy
        (mine_as_is, other_as_is), (mine_swapped, other_swapped) = explained.log_likelihoods.tolist()
        odds = -mine_as_is + mine_swapped - other_as_is + other_swapped
        if not odds > self.threshold:
            return (0.0 if math.isnan(odds) else odds), None
        forwards = [np.flatnonzero(explained.fits[1] & (owners[1] == track))[::-1] for track in (0, 1)]
        one, two = (self.filter_again(rows.take(index), prior) for index in forwards)
        return odds, (one, two)

    def filter_again(self, rows: ClaimedRows, prior: NewObjects) -> Track:
        """Filter the detections of one track again, in the order of the rows."""
        explained = self._explain(rows, np.zeros((1, len(rows.times)), dtype=np.int64), prior)
        log_likelihood = float(explained.log_likelihoods[0, 0])
        mean, covariance = explained.means[0, 0], explained.covariances[0, 0]
        camera, time_s = int(rows.cameras[-1]), float(rows.times[-1])
        return Track(log_likelihood, explained.fits[0], mean, covariance, camera, time_s)

    def _explain(self, rows: ClaimedRows, owners: Integers, prior: NewObjects) -> ExplainedRows:
        """Filter detections again, each in the track (h, n) that an explanation gives it to."""
        paths = make_paths(owners, rows.times)
        motion = self.motion.arrays(paths.intervals)
        out = room_for_explained(len(owners), owners.shape[1], self.motion.state_size)
        spaces = self.rig.spaces(rows.cameras, rows.times)
        explain_rows(rows, spaces, prior, paths, motion, self._draws, LATEST, out)
        return out


class Track(NamedTuple):
    """A track filtered again: which detections fit it, and its Gaussian (d,), (d, d) where and when the last was."""

    log_likelihood: float
    fits: NDArray[np.bool_]
    mean: Array
    covariance: Array
    camera: int
    time_s: float


def _place(mean: Array, space: Array, elapsed_s: float) -> Array:
    """Place (3,) in the world of a mean in a packed disparity space, a while later; NaN at no positive disparity."""
    moved = mean[:3] + elapsed_s * mean[3:6] if len(mean) == 6 else mean
    return np.array(place_in_world(moved, space)[:3] if moved[2] > 0.0 else [np.nan] * 3)


def _replaced(mixture: GaussianMixture, first: int, second: int, tracks: tuple[Track, Track]) -> GaussianMixture:
    """Return a mixture in which each of two labels has one Gaussian."""
    kept = np.ones(mixture.size, dtype=bool)
    heads = []
    for label in (first, second):
        found = np.flatnonzero(mixture.labels == label)
        kept[found[1:]] = False
        heads.append(int(found[0]))
    out = mixture.take(np.arange(mixture.size))
    for head, label, one in zip(heads, (first, second), tracks, strict=True):
        out.weights[head] = mixture.weights[mixture.labels == label].sum()
        out.means[head], out.covariances[head] = one.mean, one.covariance
        out.cameras[head], out.times[head] = one.camera, one.time_s
    return out.take(np.flatnonzero(kept))
