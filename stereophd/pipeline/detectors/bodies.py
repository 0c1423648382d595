"""What the boxes of an event show of the detector that made them, and what is known of it before."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Integers
from stereophd.core.bodies.boxes import box_variances, boxes_of, share_in_image
from stereophd.core.bodies.filter import LEAST_HIDDEN, BodyState
from stereophd.core.bodies.occlusion import hidden_shares
from stereophd.core.bodies.outline import BOTTOM, TOP, outline_boxes
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import BOX_NOISE, Camera, Detector
from stereophd.core.multi.state.estimates import Info
from stereophd.pipeline.detectors import statistics

# Spread of the logarithm of the noise of boxes between detectors, and the clutter of an unknown one.
SPREAD, USUAL_CLUTTER = 0.5, 1.0


def starting_box_detectors(
    cameras: Sequence[Camera], estimated: Collection[str]
) -> tuple[tuple[Camera, ...], dict[str, statistics.NoisePrior]]:
    """Return cameras with detectors to begin with where they are `estimated`, and what is known of their noise."""
    usual = [Detector(camera.detector.sigma, statistics.USUAL_P_DETECT, USUAL_CLUTTER, BOX_NOISE) for camera in cameras]
    started = tuple(
        replace(camera, detector=detector) if camera.name in estimated else camera
        for camera, detector in zip(cameras, usual, strict=True)
    )
    return started, {name: statistics.NoisePrior(np.array(BOX_NOISE), SPREAD) for name in estimated}


def observe_bodies(
    sums: statistics.DetectorSums,
    before: BodyState,
    info: Info,
    event: Event,
    camera: Camera,
    shape: EllipsoidSettings,
    settled: Integers,
) -> statistics.Sighting:
    """Add the residuals of the boxes of a frame to the sums of its camera; return which bodies it detected.

    Only bodies of `settled` labels count that are whole in the image, that nothing hides and that one Gaussian
    describes. `before` is the state predicted to the event, `info` what the update found.
    """
    hypotheses = before.hypotheses
    first = hypotheses.first()
    means, covariances = hypotheses.means[first], hypotheses.covariances[first]
    existence = hypotheses.existence(len(before.labels))
    projected, slopes = outline_boxes(means, camera, shape.direction)
    hidden = hidden_shares(projected, means, covariances, existence, camera)
    chosen = np.isin(before.labels, settled) & (hypotheses.weights[first] > statistics.DECIDED_SHARE * existence)
    chosen &= (hypotheses.views[first] < 0) & (hidden < LEAST_HIDDEN) & (share_in_image(projected, camera) == 1.0)
    rows = np.flatnonzero(chosen)
    if not len(rows):
        return statistics.Sighting(np.empty(0, dtype=np.int64), np.empty(0), np.empty(0))
    owners, columns, shares = statistics.of_labels(info.claims, before.labels)
    total = np.bincount(owners, shares, len(before.labels))[rows]
    boxes = boxes_of(event, camera)
    known = chosen[owners] & (shares > statistics.LIKELY) & ~boxes.hidden[columns].any(axis=1)
    owners, columns, shares = owners[known], columns[known], shares[known]
    if len(owners):
        heights = projected[owners, BOTTOM] - projected[owners, TOP]
        noise = box_variances(heights, boxes.scales[columns], np.array(camera.detector.box_noise))
        spread = np.einsum("kij,kjl,kil->ki", slopes[owners], covariances[owners], slopes[owners])
        residuals = boxes.values[columns] - projected[owners]
        sums.add(residuals, spread + noise, noise, shares, before.labels[owners])
    detected = np.minimum(total, existence[rows]).astype(np.float64)
    return statistics.Sighting(before.labels[rows], detected, existence[rows] - detected)
