"""The data of each run that the page's script draws, as JSON-able values."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.observability import UNDETERMINED_RATIO
from stereophd.core.geometry.camera import Camera
from stereophd.pipeline.inspection.runs import Evaluation, Run
from stereophd.report.page.columns import Paths, binned, chosen, packed, paths_of, thinned
from stereophd.report.page.frames import camera_frames, paths_of_run, residuals
from stereophd.report.plots.views import down_axis
from stereophd.report.summaries import verdict
from stereophd.wording import shown_unit

# Numbers of rows of all runs together: with the script of plotly the page stays below 10 MB.
TRACK_ROWS = 50_000
TRUTH_ROWS = 20_000
FRAME_ROWS = 36_000
RESIDUAL_ROWS = 16_000
# Numbers of rows of one run.
SCANS = 1200
PARTICLES = 600
HISTORY = 300
POSES = 60

# Distances below this share of the cutoff are rounding errors.
LEAST_DISTANCE = 1e-6

# Depth of a drawn view as a share of the size of the scene.
FRUSTUM = 0.12


def run_data(run: Run, runs: int) -> dict[str, Any]:
    """Return the drawn data of one of `runs` runs."""
    paths = None if run.tracks is None else paths_of_run(run)
    truth = _truth(run)
    start, end = _period(run, paths)
    vertical, is_down = down_axis(run.cameras)
    data: dict[str, Any] = {
        "name": run.name,
        "command": run.command,
        "unit": run.length_unit,
        "verdict": verdict(run.report, None if run.evaluation is None else run.evaluation.report),
        "start": start,
        "end": end,
        "up": [0.0 if axis != vertical else (-1.0 if is_down else 1.0) for axis in range(3)],
        "axes": list("xyz"),
        "cameras": _cameras(run.cameras, paths, truth, start, end),
    }
    if paths is not None:
        data["tracks"] = _path_data(thinned(paths, TRACK_ROWS // runs), start)
        if run.cameras:
            data["frames"] = camera_frames(run, paths, FRAME_ROWS // runs, start)
            data["whole_frames"] = run.log is not None
            data["residuals"] = residuals(run, paths, RESIDUAL_ROWS // runs, start)
    if truth is not None:
        data["truth"] = _path_data(thinned(truth, TRUTH_ROWS // runs), start)
    if run.scans is not None:
        columns = {name: run.scans[name].astype(float) for name in ("cardinality_mean", "cardinality_estimate")}
        data["scans"] = _timed(binned(run.scans["time_s"], columns, SCANS), start)
    if run.evaluation is not None and run.evaluation.scores:
        data["evaluation"] = _evaluation(run.evaluation, start)
    if run.report.get("parameters"):
        data["calibration"] = _calibration(run, start)
    return data


def _truth(run: Run) -> Paths | None:
    if run.truth is None:
        return None
    columns = {axis: run.truth.position[:, k] for k, axis in enumerate("xyz")}
    return paths_of(run.truth.object_id, {"time_s": run.truth.time_s, **columns})


def _period(run: Run, paths: Paths | None) -> tuple[float, float]:
    for times in (
        None if run.scans is None else run.scans["time_s"],
        None if paths is None else paths.times,
        None if run.evaluation is None else run.evaluation.scores.get("time_s"),
        None if run.history is None else run.history["time_s"],
    ):
        if times is not None and len(times):
            return float(times.min()), float(times.max())
    return 0.0, 0.0


def _path_data(paths: Paths, start: float) -> dict[str, Any]:
    rows = {name: packed(paths.columns[name]) for name in paths.columns if name not in ("time_s", "vx", "vy", "vz")}
    first, last = paths.starts[:-1], paths.starts[1:] - 1
    return {
        "ids": paths.ids.tolist(),
        "starts": paths.starts.tolist(),
        "t": packed(paths.times - start),
        "first": packed(paths.times[first] - start),
        "last": packed(paths.times[last] - start),
        **rows,
    }


def _timed(columns: Mapping[str, Array], start: float) -> dict[str, str]:
    """Columns with time relative to the start, in compact form."""
    return {
        "t": packed(columns["time_s"] - start),
        **{name: packed(values) for name, values in columns.items() if name != "time_s"},
    }


def _cameras(
    cameras: Sequence[Camera], paths: Paths | None, truth: Paths | None, start: float, end: float
) -> list[dict[str, Any]]:
    """Image sizes, and views as the corners of a pyramid, at several times if a camera moves."""
    points = [
        np.stack([drawn.columns[axis] for axis in "xyz"], axis=1) for drawn in (paths, truth) if drawn is not None
    ]
    centers = np.array([camera.at(start).pose.center for camera in cameras]).reshape(-1, 3)
    scene = np.concatenate([*points, centers])
    scene = scene[np.isfinite(scene).all(axis=1)]
    # of most points: a track that goes astray does not make the cameras huge
    size = float(np.ptp(np.quantile(scene, [0.02, 0.98], axis=0), axis=0).max()) if len(scene) else 1.0
    out = []
    for camera in cameras:
        times = np.array([start]) if camera.pose.is_static else np.linspace(start, end, POSES)
        out.append(
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "t": (times - start).tolist(),
                "corners": packed(np.stack([_pyramid(camera.at(t), FRUSTUM * (size or 1.0)) for t in times.tolist()])),
            }
        )
    return out


def _pyramid(camera: Camera, depth: float) -> Array:
    """Centre and the corners of the image (5, 3) at a depth, of the pinhole camera: a lens may not reach them."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [camera.width, camera.height] - 0.5
    return np.concatenate([camera.pose.center[None], camera.pose.to_world(depth * camera.pinhole_rays(corners))])


def _evaluation(evaluation: Evaluation, start: float) -> dict[str, Any]:
    """Scores over time; GOSPA as its parts, which follow from the numbers of objects, estimates and pairs."""
    report, scores = evaluation.report, evaluation.scores
    order, cutoff = float(report["ospa"]["order"]), float(report["ospa"]["cutoff"])
    missed = (scores["n_truth"] - scores["n_matched"]).astype(float)
    false = (scores["n_estimates"] - scores["n_matched"]).astype(float)
    penalty = 0.5 * cutoff**order
    localisation = np.maximum(scores["gospa"] ** order - penalty * (missed + false), 0.0) ** (1.0 / order)
    names = ("ospa", "ospa_localisation", "ospa_cardinality", "gospa", "n_truth", "n_estimates")
    columns = {
        **{name: scores[name].astype(float) for name in names},
        # nothing but rounding, where no object and no estimate match
        "gospa_localisation": np.where(localisation > LEAST_DISTANCE * cutoff, localisation, 0.0),
        "gospa_missed": (penalty * missed) ** (1.0 / order),
        "gospa_false": (penalty * false) ** (1.0 / order),
    }
    return {
        **_timed(binned(scores["time_s"], columns, SCANS), start),
        "order": order,
        "cutoff": cutoff,
        "base": report["ospa"]["base"],
    }


def _calibration(run: Run, start: float) -> dict[str, Any]:
    """Parameters in the units that are drawn, their history, particles, and the directions of the posterior."""
    names, factors, parameters = [], [], []
    for estimate in run.report["parameters"]:
        factor, unit = shown_unit(estimate["unit"])
        names.append(estimate["name"])
        factors.append(factor)
        parameters.append(
            {
                "name": estimate["name"],
                "unit": unit,
                "prior": factor * estimate["prior_std"],
                "mean": None if estimate["mean"] is None else factor * estimate["mean"],
                "std": factor * estimate["std"],
                "determined": estimate["determined_by_data"],
            }
        )
    data: dict[str, Any] = {"parameters": parameters, "status": run.report["status"]}
    directions = (run.report.get("observability") or {}).get("directions") or ()
    data["directions"] = [
        {
            "ratio": direction["posterior_over_prior_std"],
            "determined": direction["posterior_over_prior_std"] <= UNDETERMINED_RATIO,
            "text": ", ".join(f"{name} {part:+.2f}" for name, part in direction["direction"].items()),
        }
        for direction in directions
    ]
    if run.history is not None and len(run.history["time_s"]):
        rows = chosen(len(run.history["time_s"]), HISTORY)
        stds = np.sqrt(np.maximum(np.einsum("tii->ti", run.history["covariance"][rows]), 0.0))
        data["history"] = {
            "t": packed(run.history["time_s"][rows] - start),
            "mean": [packed(f * run.history[n][rows]) for n, f in zip(names, factors, strict=True)],
            "std": [packed(f * stds[:, k]) for k, f in enumerate(factors)],
        }
    if run.posterior is not None and len(run.posterior["weight"]):
        weights = run.posterior["weight"]
        # systematic resampling: points of equal weight
        edges = np.cumsum(weights / weights.sum())
        rows = np.searchsorted(edges, (np.arange(PARTICLES) + 0.5) / PARTICLES).clip(0, len(weights) - 1)
        data["particles"] = [packed(f * run.posterior[n][rows]) for n, f in zip(names, factors, strict=True)]
    return data
