"""Speeds or a length of the scene that are known: its scale, once the trajectories are fitted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereophd.core.calibration.fits import adjusted_to
from stereophd.core.calibration.scale import ScaleMeasurement, log_scale
from stereophd.core.calibration.task import Fit, Task
from stereophd.core.calibration.trajectories import interpolation, positions

Array = NDArray[np.float64]

# Steps in which the length of a path is measured, and the part of their distance to which two objects keep it.
SPEED_STEPS = 200
RIGID = 0.02


def measured_scale(task: Task, fit: Fit, kind: str, value: float, std: float) -> ScaleMeasurement | None:
    """What the known speed of all objects, or the known distance of two, says of the scale.

    Speeds and distances in units of the scene's scale do not depend on it, so each says what the scale is:
    log s + log(known / found). The speeds of k objects do so independently.

    Parameters
    ----------
    task, fit : Task, Fit
    kind : str
        ``speed`` (mean speed of every object) or ``length`` (distance of the two that keep it best).
    value, std : float
        What is known.

    Returns
    -------
    ScaleMeasurement or None
        None if no two objects keep their distance.
    """
    logarithm, _ = log_scale(task.parameters, task.reference, fit.adjustment.values)
    if kind == "speed":
        found = mean_speeds(fit)
    else:
        distance = rigid_distance(fit)
        if distance is None:
            return None
        found = np.array([distance])
    target = logarithm + float(np.log(value / found).mean())
    return ScaleMeasurement("log_scale", target, std / value / np.sqrt(len(found)))


def rescaled(task: Task, fit: Fit, measurement: ScaleMeasurement) -> Fit:
    """Adjust again, with the scale measured."""
    return adjusted_to(task, fit, fit.observations, fit.observations.trajectories, fit.detections, measurement)


def mean_speeds(fit: Fit) -> Array:
    """Mean speed of every trajectory, length/s."""
    out = []
    for j, (start, end) in enumerate(fit.knots.spans):
        times = np.linspace(start, end, SPEED_STEPS + 1)
        path = positions(fit.adjustment.states, *interpolation(fit.knots, np.full(len(times), j), times))
        out.append(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) / max(end - start, 1e-300))
    return np.array(out)


def rigid_distance(fit: Fit) -> float | None:
    """Mean distance of the two trajectories that keep it best, length; None if none do to `RIGID` of it."""
    best, kept = RIGID, None
    for i in range(fit.knots.count):
        for j in range(i):
            start, end = max(fit.knots.spans[[i, j], 0]), min(fit.knots.spans[[i, j], 1])
            if end <= start:
                continue
            times = np.linspace(start, end, SPEED_STEPS)
            paths = [
                positions(fit.adjustment.states, *interpolation(fit.knots, np.full(len(times), k), times))
                for k in (i, j)
            ]
            distances = np.linalg.norm(paths[0] - paths[1], axis=1)
            if distances.std() < best * distances.mean():
                best, kept = float(distances.std() / distances.mean()), float(distances.mean())
    return kept
