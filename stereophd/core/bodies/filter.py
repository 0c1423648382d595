"""Poisson multi-Bernoulli filter of bodies, in the world: boxes in, positions, velocities and sizes out.

The track-oriented marginal filter (Williams 2015), as `stereophd.core.multi.pmb`, with other states and detections. A
track is a Bernoulli component with a mixture of hypotheses, each a Gaussian of position, velocity and the logarithms of
the half axes. Why not disparity space: the middle and the sides of a box are no linear functions of any three of these
numbers, since the size over the depth comes in; only (u, v, d) of the centre remains linear, which a box does not
measure. The observation is linearised about the prediction instead (an extended Kalman filter): boxes are wide, 0.05 of
their height, and a frame moves the linearisation by less.

The frames of one instant are associated jointly: a hypothesis keeps its boxes until the instant is over, and each frame
makes the earlier associations of the instant anew (`stereophd.core.bodies.hypotheses.reassociate`). Whether a track is
reported is decided by all of them together.

A box that no track claims is a body, clutter, or the first of a false object: a poster, a mirror image or a part of
the furniture, which stays in its place and is seen by one camera only. A false object is a hypothesis of its track; it
hides nothing, and is not reported.

Reference: J. L. Williams, "Marginal multi-Bernoulli filters: RFS derivation of MHT, JIPDA and association-based
MeMBer", IEEE Trans. AES 51 (3), 2015.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.bodies.births import Newborns, body_shares_left, depths_inside, newborn_bodies
from stereophd.core.bodies.boxes import WHOLE_SHARE, Boxes, box_variances, boxes_of, share_in_image
from stereophd.core.bodies.hypotheses import Hypotheses, box_factors, merged, reassociate, reduce_hypotheses
from stereophd.core.bodies.occlusion import CUT_SHARE, detection_probabilities, hidden_shares
from stereophd.core.bodies.outline import BOTTOM, LOG_AXES, STATE_SIZE, TOP, VELOCITY, U, outline_boxes
from stereophd.core.bodies.prediction import predict_bodies
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.disparity.events import Event, Rig
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.base import Motion
from stereophd.core.multi.association.attribution import Claims
from stereophd.core.multi.association.exact_association import association_marginals
from stereophd.core.multi.births.undetected import Undetected, all_undetected, birth_rates, expected_births
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.core.multi.state.inputs import EventNumbers

# Gate of each value of a box, standard deviations, and of all together (squared).
GATE, GATE_SQUARED = 5.0, 36.0
# Bodies of whose box less is hidden are seen whole.
LEAST_HIDDEN = 0.05
# Share of the false boxes that are the first of a false object, such as a poster or a mirror image, which one camera
# goes on to see, where other cameras see nothing; and the probability that it does.
STAYING_SHARE, FALSE_DETECTED = 0.05, 0.8
# A track is no longer reported where a body is less than this part as probable as a false object.
FALSE_RELEASE = 0.1
# Rounds over the associations of the cameras of one instant: after a single one the order of the cameras decides.
ROUNDS = 2


@dataclass(frozen=True)
class BodyState:
    """Tracks after an event."""

    hypotheses: Hypotheses
    # `labels`, `track_ids`: (t,): Of the tracks; a track that was never reported has no identity yet, -1
    labels: Integers
    track_ids: Integers
    # `reported`, `shown`: (t,): Whether the last instant reported the track, and whether the open one does so far
    reported: Booleans
    shown: Booleans
    time_s: float | None = None  # Of the last event, None before the first
    next_label: int = 0
    next_track: int = 0
    undetected: Undetected | None = None
    # Of the open instant: its start, and the number of boxes of each camera (-1: no frame yet)
    instant_s: float = -math.inf
    counts: tuple[int, ...] = ()


class Pairs(NamedTuple):
    """Hypotheses (rows) and boxes (columns) that may belong together, k of them."""

    rows: Integers
    columns: Integers
    log_odds: Array  # (k,): Logarithm of the likelihood over the density of clutter
    gains: Array  # (k, 8, 4)
    residuals: Array  # (k, 4)
    projections: Array  # (k, 4, 8): Of the observation


@dataclass(frozen=True)
class BodyFilter:
    """A filter of bodies, as `stereophd.pipeline.tracking.loop` runs it."""

    rig: Rig
    motion: Motion
    shape: EllipsoidSettings
    settings: PmbSettings

    def init(self) -> BodyState:
        """Return the state before the first event: no bodies."""
        none = np.empty(0, dtype=np.int64)
        empty = np.empty((0, STATE_SIZE)), np.empty((0, STATE_SIZE, STATE_SIZE))
        hypotheses = Hypotheses.undecided(none, np.empty(0), *empty, none, len(self.rig.cameras))
        return BodyState(hypotheses, none, none, none.astype(np.bool_), none.astype(np.bool_))

    def step(self, state: BodyState, event: Event) -> tuple[BodyState, Info, Estimates]:
        """Predict, update and report for one event."""
        camera = self.rig.cameras[event.camera].at(event.time_s)
        elapsed = 0.0 if state.time_s is None else max(event.time_s - state.time_s, 0.0)
        state, info = self._update(self.predict(state, event), event, camera, elapsed)
        return self._extract(state, info)

    def predict(self, state: BodyState, event: Event) -> BodyState:
        """Return the state before the boxes of an event; one that opens an instant ends the one before."""
        if event.time_s - state.instant_s >= self.shape.instant_s or state.counts[event.camera] >= 0:
            hypotheses = merged(state.hypotheses, self.settings.hypothesis_distance)
            none = (-1,) * len(self.rig.cameras)
            state = replace(state, hypotheses=hypotheses, reported=state.shown, instant_s=event.time_s, counts=none)
        return self._predicted(state, event.time_s)

    def forecast(self, state: BodyState, info: Info, time_s: float) -> tuple[Info, Estimates]:
        """Predict the bodies of a state to a later time at which no camera reported."""
        later = self._predicted(state, time_s)
        faded = float(later.hypotheses.weights.sum()) / max(float(state.hypotheses.weights.sum()), 1e-300)
        info = replace(info, log_likelihood=0.0, cardinality_mean=info.cardinality_mean * min(faded, 1.0))
        return self._extract(later, info)[1:]

    def _predicted(self, state: BodyState, time_s: float) -> BodyState:
        """Let bodies move and survive; those outside every view or the region fade with `out_of_view_s`."""
        hypotheses = state.hypotheses
        elapsed = 0.0 if state.time_s is None else max(time_s - state.time_s, 0.0)
        if not len(hypotheses.weights) or elapsed == 0.0:
            return replace(state, time_s=time_s)
        means, covariances = hypotheses.means.copy(), hypotheses.covariances.copy()
        moves = np.flatnonzero(hypotheses.views < 0)
        means[moves], covariances[moves] = predict_bodies(
            means[moves], covariances[moves], elapsed, self.motion, self.shape
        )
        weights = hypotheses.weights * self.settings.survival_per_s**elapsed
        fading = math.exp(-elapsed / self.settings.out_of_view_s)
        weights = np.where(self._is_in_reach(means, time_s), weights, weights * fading)
        hypotheses = hypotheses._replace(weights=weights, means=means, covariances=covariances)
        return replace(state, hypotheses=hypotheses, time_s=time_s)

    def _is_in_reach(self, states: Array, time_s: float) -> Booleans:
        """Which bodies (n,) are in the view of some camera, and touch the region."""
        up = self.shape.direction
        seen = np.zeros(len(states), dtype=np.bool_)
        for camera in self.rig.cameras:
            rest = np.flatnonzero(~seen)
            if not len(rest):
                break
            frozen = camera.at(time_s)
            seen[rest] = share_in_image(outline_boxes(states[rest], frozen, up)[0], frozen) > 0.0
        if self.rig.region is None:
            return seen
        return seen & (depths_inside(states, self.rig.region, up) >= 0.0).all(axis=1)

    def _update(self, state: BodyState, event: Event, camera: Camera, elapsed: float) -> tuple[BodyState, Info]:
        """Update with the boxes of an event (Williams 2015, section IV), then reduction."""
        hypotheses, n_tracks = state.hypotheses, len(state.labels)
        owners, weights = hypotheses.owners, hypotheses.weights
        boxes = boxes_of(event, camera)
        projected, slopes = outline_boxes(hypotheses.means, camera, self.shape.direction)
        hidden = self._hidden(hypotheses, projected, camera)
        detection = detection_probabilities(projected, hidden, camera, self.shape)
        false = hypotheses.views >= 0
        detection[false] = np.where(hypotheses.views[false] == event.camera, FALSE_DETECTED, 0.0)
        existence = np.bincount(owners, weights, n_tracks)
        missed = weights * (1.0 - detection)
        not_detected = 1.0 - existence + np.bincount(owners, missed, n_tracks)

        detector, birth = camera.detector, self.settings.birth
        known = float((weights * detection).sum())
        numbers = EventNumbers(
            event.camera, event.time_s, elapsed, state.next_label, len(event.points), detector.p_detect, 0.0,
            float(camera.width * camera.height), 1.0, self.settings.out_of_view_s, detector.expected_clutter, 0.0,
        )  # fmt: skip
        before = state.undetected or all_undetected(len(self.rig.cameras))
        births, undetected, burst = expected_births(
            before, birth_rates(birth), self._left[event.camera], numbers, known
        )
        clutter = max(detector.expected_clutter, float(burst))
        pairs = self._pairs(hypotheses, projected, slopes, hidden, boxes, camera)
        with np.errstate(over="ignore"):
            masses = weights[pairs.rows] * detection[pairs.rows] * np.exp(np.minimum(pairs.log_odds, 500.0)) / clutter
        # a new track whose box others claim with odds m exists with a probability of the order of 1 / m: it is pruned
        claimed = np.bincount(pairs.columns, masses, len(boxes)) * self.settings.prune_weight > 1.0
        newborns, born = self._newborns(boxes, ~claimed, camera, births * detector.p_detect / clutter)
        stays = STAYING_SHARE * self._is_in_other_views(newborns, event) * ~claimed

        keys, inverse = np.unique(owners[pairs.rows] * max(len(boxes), 1) + pairs.columns, return_inverse=True)
        tracks, columns = keys // max(len(boxes), 1), keys % max(len(boxes), 1)
        shared = np.bincount(inverse, masses, len(keys))
        odds = shared / (np.maximum(not_detected[tracks], 1e-12) * (1.0 + born[columns]))
        taken, missing, unclaimed, log_evidence = association_marginals(tracks, columns, odds, n_tracks, len(boxes))

        detected_weights = taken[inverse] * masses / np.maximum(shared[inverse], 1e-300)
        missed_weights = missing[owners] * missed / np.maximum(not_detected[owners], 1e-12)
        newborn_weights = unclaimed * born / (1.0 + born)
        staying_weights = unclaimed * stays / (1.0 + born)
        log_likelihood = (
            -clutter - births * detector.p_detect + float(np.log(np.maximum(not_detected, 1e-300)).sum()) + log_evidence
            + float((boxes.log_clutter + math.log(clutter) + np.log1p(born)).sum())
        )  # fmt: skip

        labels = np.concatenate([state.labels, state.next_label + np.arange(len(boxes))])
        info = self._info(state.labels, labels, tracks, columns, taken, missing * (existence > 0), newborn_weights)
        factors = box_factors(taken, missing[tracks], shared / np.maximum(not_detected[tracks], 1e-12))[inverse]
        alone = newborn_weights + staying_weights
        odds = (born + stays) / (1.0 - stays)
        newborn_factors = box_factors(alone, 1.0 - alone, odds)
        joined = self._joined(
            hypotheses, pairs, newborns, (missed_weights, detected_weights, newborn_weights, staying_weights),
            (factors, newborn_factors), n_tracks, event.camera,
        )  # fmt: skip
        counts = (*state.counts[: event.camera], len(boxes), *state.counts[event.camera + 1 :])
        others = [k for k, count in enumerate(counts) if count > 0 and k != event.camera]
        for k in [*others, event.camera] * ROUNDS if others and len(boxes) else ():
            joined = reassociate(joined, k, len(labels), counts[k])
        reported = np.concatenate([state.reported, np.zeros(len(boxes), dtype=np.bool_)])
        reduced, kept = reduce_hypotheses(joined, reported, self.settings, self.shape.direction)
        identities = np.concatenate([state.track_ids, np.full(len(boxes), -1)])
        state = replace(
            state, hypotheses=reduced, labels=labels[kept], track_ids=identities[kept],
            reported=reported[kept], next_label=state.next_label + len(boxes),
            undetected=undetected, counts=counts,
        )  # fmt: skip
        return state, replace(
            info, log_likelihood=log_likelihood, cardinality_mean=float(reduced.weights[reduced.views < 0].sum()),
            n_components=len(reduced.weights), burst=burst,
        )  # fmt: skip

    @cached_property
    def _left(self) -> list[Array]:
        """Return the share (c, c) of the objects in view of each camera that a frame of each camera leaves."""
        return list(np.ascontiguousarray(body_shares_left(self.rig.cameras, self.shape).T))

    def _hidden(self, hypotheses: Hypotheses, projected: Array, camera: Camera) -> Array:
        """Shares (n,) of the boxes of the hypotheses that nearer bodies are expected to hide."""
        if self.shape.hidden_loss == 0.0 or not len(projected):
            return np.zeros(len(projected))
        first = hypotheses.first()
        existence = hypotheses.existence(len(first))
        means, covariances = hypotheses.means[first], hypotheses.covariances[first]
        return hidden_shares(projected[first], means, covariances, existence, camera)[hypotheses.owners]

    def _pairs(
        self, hypotheses: Hypotheses, projected: Array, slopes: Array, hidden: Array, boxes: Boxes, camera: Camera
    ) -> Pairs:
        """Return the hypotheses and boxes that the gates let pass.

        The box of a body that others hide may be cut at the bottom: such a pair is there twice, with the bottom as
        measured, and with a bottom that may be anywhere in the image of the body.
        """
        parts = np.asarray(camera.detector.box_noise)
        carried = hypotheses.covariances @ slopes.swapaxes(1, 2)
        spread = slopes @ carried
        heights = projected[:, BOTTOM] - projected[:, TOP]
        with np.errstate(invalid="ignore"):
            widest = np.sqrt(spread[:, range(4), range(4)] + box_variances(heights, np.ones((len(heights), 4)), parts))
            beside = np.abs(boxes.values[:, U] - projected[:, U, None]) <= GATE * widest[:, U, None]
        rows, columns = np.nonzero((beside | boxes.hidden[:, U]) & np.isfinite(heights)[:, None])
        off = boxes.values[columns] - projected[rows]
        inside = (np.abs(off) <= GATE * widest[rows]) | boxes.hidden[columns]
        may_be_cut = (hidden[rows] >= LEAST_HIDDEN) & (off[:, BOTTOM] < 0.0) & ~boxes.hidden[columns, BOTTOM]
        whole = np.flatnonzero(inside.all(axis=1))
        cut = np.flatnonzero(np.delete(inside, BOTTOM, axis=1).all(axis=1) & may_be_cut)
        rows, columns = (np.concatenate([values[whole], values[cut]]) for values in (rows, columns))
        is_cut = np.arange(len(rows)) >= len(whole)
        missing = boxes.hidden[columns]
        missing[is_cut, BOTTOM] = True
        selections = np.where(missing[:, :, None], 0.0, boxes.selections[columns])
        noise = box_variances(heights[rows], boxes.scales[columns], parts)
        full = spread[rows]
        full[:, range(4), range(4)] += noise
        innovation = selections @ full @ selections.swapaxes(1, 2)
        innovation[:, range(4), range(4)] += missing
        inverses = np.linalg.inv(innovation)
        residuals = np.einsum("kij,kj->ki", selections, boxes.values[columns] - projected[rows])
        squared = np.einsum("ki,kij,kj->k", residuals, inverses, residuals)
        observed = 4 - missing.sum(axis=1)
        share = CUT_SHARE * hidden[rows]
        log_odds = (
            -0.5 * (squared + np.linalg.slogdet(innovation)[1] + observed * math.log(2.0 * math.pi))
            - boxes.log_clutter[columns]
            + np.log(np.where(is_cut, share / heights[rows], 1.0 - share))
        )
        gains = carried[rows] @ selections.swapaxes(1, 2) @ inverses
        near = squared < GATE_SQUARED
        projections = selections @ slopes[rows]
        return Pairs(rows[near], columns[near], log_odds[near], gains[near], residuals[near], projections[near])

    def _newborns(self, boxes: Boxes, free: Booleans, camera: Camera, rate: float) -> tuple[Newborns, Array]:
        """Return the bodies that the boxes may have given birth to, and their odds against clutter (m,)."""
        size, chosen = len(boxes), np.flatnonzero(free & (rate > 0.0))
        out = Newborns(np.zeros((size, STATE_SIZE)), np.tile(np.eye(STATE_SIZE), (size, 1, 1)), np.full(size, -np.inf))
        if len(chosen):
            found = newborn_bodies(
                boxes.take(chosen), camera, self.shape, self.settings.birth.velocity_std, self.rig.region
            )
            for whole, part in zip((out.states, out.covariances, out.log_densities), vars(found).values(), strict=True):
                whole[chosen] = part
        odds = rate * np.exp(np.minimum(out.log_densities - boxes.log_clutter, 500.0))
        return out, odds

    def _is_in_other_views(self, newborns: Newborns, event: Event) -> Booleans:
        """Which newborns (m,) another camera has in view too."""
        out = np.zeros(len(newborns.states), dtype=np.bool_)
        born = np.flatnonzero(np.isfinite(newborns.log_densities))
        for k, other in enumerate(self.rig.cameras):
            if k != event.camera and len(born):
                frozen = other.at(event.time_s)
                boxes, _ = outline_boxes(newborns.states[born], frozen, self.shape.direction)
                out[born] |= share_in_image(boxes, frozen) >= WHOLE_SHARE
        return out

    def _joined(
        self,
        hypotheses: Hypotheses,
        pairs: Pairs,
        newborns: Newborns,
        weights: tuple[Array, Array, Array, Array],
        factors: tuple[Array, Array],
        n_tracks: int,
        camera: int,
    ) -> Hypotheses:
        """Return the hypotheses after an event: missed, updated by a box each, and newborn."""
        means = hypotheses.means[pairs.rows] + np.einsum("kij,kj->ki", pairs.gains, pairs.residuals)
        covariances = hypotheses.covariances[pairs.rows]
        covariances = covariances - pairs.gains @ (pairs.projections @ covariances)
        covariances = (covariances + covariances.swapaxes(1, 2)) / 2.0
        size = len(newborns.states)
        fresh = Hypotheses.undecided(
            n_tracks + np.tile(np.arange(size), 2), np.concatenate(weights[2:]), np.tile(newborns.states, (2, 1)),
            np.tile(newborns.covariances, (2, 1, 1)), np.repeat([-1, camera], size), hypotheses.boxes.shape[1],
        )  # fmt: skip
        # a false object does not move
        fresh.covariances[size:, VELOCITY, VELOCITY] = 1e-6 * np.eye(3)
        fresh.boxes[:, camera], fresh.factors[:, camera] = np.tile(np.arange(size), 2), np.tile(factors[1], 2)
        updated = hypotheses.take(pairs.rows)._replace(weights=weights[1], means=means, covariances=covariances)
        updated.boxes[:, camera], updated.factors[:, camera] = pairs.columns, factors[0]
        parts = hypotheses._replace(weights=weights[0]), updated, fresh
        return Hypotheses(*(np.concatenate(values) for values in zip(*parts, strict=True)))

    @staticmethod
    def _info(
        known: Integers,
        labels: Integers,
        tracks: Integers,
        columns: Integers,
        taken: Array,
        missed: Array,
        newborn: Array,
    ) -> Info:
        """Return which labels an event detected, and which boxes they claim; see `multi.association.attribution`."""
        new = np.arange(len(newborn))
        claims = Claims(
            np.concatenate([labels[tracks], labels[len(known) :]]),
            np.concatenate([columns, new]),
            np.concatenate([taken, newborn]),
        )
        total = np.bincount(tracks, taken, len(known))
        seen = np.flatnonzero(total > missed)
        detected = np.concatenate([known[seen], labels[len(known) :][newborn > 0.0]])
        return Info(0.0, 0.0, 0, detected, claims)

    def _extract(self, state: BodyState, info: Info) -> tuple[BodyState, Info, Estimates]:
        """Report tracks by their existence, with hysteresis, and give identities in order of the first report."""
        hypotheses, levels = state.hypotheses, self.settings.extraction
        existence, means, covariances = hypotheses.bodies(len(state.labels))
        shown = existence >= np.where(state.reported, levels.release, levels.confirm)
        # a false object is known to be there: it does not fade
        false = np.bincount(hypotheses.owners, hypotheses.weights, len(existence)) - existence
        shown &= existence >= FALSE_RELEASE * false
        listed = shown | (existence >= levels.tentative)
        identities = state.track_ids.copy()
        new = np.flatnonzero(listed & (identities < 0))
        identities[new] = state.next_track + np.arange(len(new))
        state = replace(state, track_ids=identities, shown=shown, next_track=state.next_track + len(new))
        chosen = np.flatnonzero(listed)
        order = chosen[np.lexsort((identities[chosen], ~shown[chosen]))]
        means, covariances = means[order], covariances[order]
        extents = 2.0 * np.exp(means[:, LOG_AXES])
        spread = extents * np.sqrt(covariances[:, range(6, 8), range(6, 8)])
        estimates = Estimates(
            identities[order], means[:, :6], covariances[:, :6, :6], existence[order], state.labels[order],
            extents=np.column_stack([extents, spread]),
        )  # fmt: skip
        return state, info, estimates.divided(int(shown[chosen].sum()))
