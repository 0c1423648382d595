"""Score calibrated cameras against true ones: errors, NEES and coverage of the posterior, Cramer-Rao bounds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import ValidationError

from stereophd.commands.options import EvaluateCamerasOptions
from stereophd.config.loading import LoadedConfig, load_cameras
from stereophd.config.model import Config
from stereophd.core.alignment.frames import moved_camera
from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import SUFFIXES
from stereophd.core.calibration.unknowns.quantities.registry import quantities
from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.calibration import normalised_error_squared, pose_errors
from stereophd.core.metrics.truth.registration import Registration
from stereophd.core.numerics.weights import weighted_mean_covariance
from stereophd.errors import InputError, unknown_camera
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.json_text import REPORT_VERSION, finite_or_none, write_json
from stereophd.io.outputs.provenance import from_metadata, provenance
from stereophd.io.tables.reading import open_parquet
from stereophd.options import takes
from stereophd.pipeline.calibration.configured_unknowns import build_parameters
from stereophd.pipeline.evaluation.calibration_bounds import bound_figures
from stereophd.pipeline.evaluation.gates import gates, raise_if_failed
from stereophd.validated import NO_LENGTH
from stereophd.wording import LOGGER

POSTERIOR_NAME, REPORT_NAME = "posterior.parquet", "report.json"
# Credible interval whose coverage is reported.
CREDIBLE = 0.9


@dataclass(frozen=True)
class Posterior:
    """Posterior of a calibration, and the parameters about whose prior mean it is stated."""

    parameters: ParameterSet
    reference: int
    particles: Array
    log_weights: Array
    has_scale: bool  # Whether its lengths are those of a known unit


@takes(EvaluateCamerasOptions)
def evaluate_calibration(
    cameras_path: Path | str,
    true_path: Path | str,
    out_dir: Path | str | None = None,
    loaded: LoadedConfig | None = None,
    *,
    options: EvaluateCamerasOptions,
) -> dict[str, Any]:
    """Compare two files ``cameras.yaml``, an estimated and the true one; ``report.json`` goes into `out_dir`, if given.

    With the ``posterior.parquet`` of `calibrate` beside the estimate, NEES and coverage of the posterior are reported
    too; with `loaded`, a scenario (``simulate``) and priors (``calibration``), the Cramer-Rao bound, its cameras the
    true ones. Cameras of one file alone are left out, with a warning, and so is the posterior if it has others than
    those in common. Returns the report. Raises InputError if a file is not usable, or the two have fewer than two
    cameras in common; GateError, which carries the report, if a figure is beyond its limit: everything has been written
    then.
    """
    estimated, true, unit = _read_pair(cameras_path, true_path)
    posterior = _posterior_of(Path(cameras_path), [camera.name for camera in true])
    chosen = _reference(estimated, true, posterior, options.reference, true_path)
    report: dict[str, Any] = {
        "report_version": REPORT_VERSION,
        "length_unit": unit,
        "reference": true[chosen].name,
        **error_figures(estimated, true, chosen),
        "quantities": quantity_errors(estimated, true),
    }
    if load_cameras(cameras_path).units.length == NO_LENGTH != unit:
        report["scale_is_unknown"] = "the estimate knows no length: errors of centres are those after scale alone"
    if posterior is not None:
        report["posterior"] = posterior_figures(posterior, true)
    if loaded is not None:
        config = loaded.config.model_copy(update={"cameras": load_cameras(true_path).cameras})
        report["bounds"] = bound_figures(replace(loaded, config=config))
    report["gates"] = gates(options.fail_above, options.fail_below, {"joint": report["joint"]})
    if out_dir is not None:
        inputs = {"cameras": cameras_path, "true_cameras": true_path}
        values = {"reference": report["reference"]} if loaded is None else loaded.record
        record = provenance("evaluate", values, inputs=inputs, length_unit=unit)
        with OutputFolder(out_dir, [REPORT_NAME], options.force) as out:
            write_json(out.path(REPORT_NAME), {**report, "provenance": record})
    raise_if_failed(report, cameras_path)
    return report


def _read_pair(cameras_path: Path | str, true_path: Path | str) -> tuple[list[Camera], list[Camera], str]:
    """Read the cameras that both files have; the estimated ones come in the order of the true ones."""
    estimated, true = load_cameras(cameras_path), load_cameras(true_path)
    names = [name for name in true.cameras if name in estimated.cameras]
    if len(names) < 2:
        raise InputError(
            f"{cameras_path}: expected two or more cameras of {true_path} ({', '.join(true.cameras)}), "
            f"found {', '.join(estimated.cameras)}"
        )
    for path, file in ((cameras_path, estimated), (true_path, true)):
        if missing := [name for name in true.cameras | estimated.cameras if name not in file.cameras]:
            LOGGER.warning("%s has no %s: not compared", path, ", ".join(missing))
    # cameras without a known length are compared all the same: their scale is an error of its own
    if estimated.units.length not in (true.units.length, NO_LENGTH):
        raise InputError(
            f"{cameras_path}: units.length: expected {true.units.length} as in {true_path}, "
            f"found {estimated.units.length}"
        )
    built = [[file.cameras[name].build(name) for name in names] for file in (estimated, true)]
    return built[0], built[1], true.units.length


def _posterior_of(cameras_path: Path, names: list[str]) -> Posterior | None:
    """Return the posterior beside a file of cameras; None if there is none, or one of other cameras."""
    path = cameras_path.with_name(POSTERIOR_NAME)
    posterior = read_posterior(path)
    if posterior is None:
        return None
    found = [camera.name for camera in posterior.parameters.cameras]
    if set(found) == set(names):
        return posterior
    LOGGER.warning(
        "%s: expected the posterior of the cameras %s, found that of %s: it is ignored",
        path, ", ".join(names), ", ".join(found),
    )  # fmt: skip
    return None


def _reference(
    estimated: list[Camera], true: list[Camera], posterior: Posterior | None, name: str | None, path: Path | str
) -> int:
    names = [camera.name for camera in true]
    if name is not None and name not in names:
        raise InputError(f"{path}: reference: {unknown_camera(name, names)}")
    if name is None and posterior is not None:
        name = posterior.parameters.cameras[posterior.reference].name
    if name is not None:
        return names.index(name)
    same = [i for i, (a, b) in enumerate(zip(estimated, true, strict=True)) if a.pose == b.pose]
    return same[0] if same else 0


def error_figures(estimated: list[Camera], true: list[Camera], reference: int) -> dict[str, Any]:
    """Errors of every camera and of all together (root mean squares), angles in degrees."""
    errors = pose_errors([c.pose for c in estimated], [c.pose for c in true], reference)
    others = [camera.name for k, camera in enumerate(true) if k != reference]
    columns = {
        "rotation_deg": np.degrees(errors.rotation),
        "direction_deg": np.degrees(errors.direction),
        "scale_ratio": errors.scale_ratio,
        "center": errors.center,
        "center_after_scale": errors.center_after_scale,
    }
    cameras = {
        name: {key: finite_or_none(column[k]) for key, column in columns.items()} for k, name in enumerate(others)
    }
    joint: dict[str, Any] = {
        key: finite_or_none(np.sqrt((column**2).mean())) for key, column in columns.items() if key != "scale_ratio"
    }
    joint["scale_ratio"] = finite_or_none(errors.common_scale)
    return {"cameras": cameras, "joint": joint}


def quantity_errors(estimated: list[Camera], true: list[Camera]) -> dict[str, Any]:
    """Return errors (estimated less true) of all quantities but poses, in their units; errors of factors are ratios."""
    out: dict[str, Any] = {}
    for one, other in zip(estimated, true, strict=True):
        figures = {}
        for quantity in quantities():
            if quantity.name in ("center", "rotation"):
                continue
            found = SUFFIXES[quantity.unit][1] * quantity.difference(other, one)
            for component, value in zip(quantity.components, found.tolist(), strict=True):
                if component in quantity.available(other):
                    figures[quantity.key(component)] = finite_or_none(value)
        out[other.name] = figures
    return out


def read_posterior(path: Path) -> Posterior | None:
    """Read a ``posterior.parquet`` with the parameters of its provenance; None if there is none."""
    if not path.exists():
        return None
    with open_parquet(path, "posterior") as parquet:
        table: pa.Table = parquet.read()
        record = from_metadata(parquet.schema_arrow.metadata)
    if record is None:
        raise InputError(f"{path}: expected a posterior of stereophd calibrate, found one without its configuration")
    try:
        config = Config.model_validate(record["config"])
    except (KeyError, ValidationError) as error:
        raise InputError(
            f"{path}: expected the configuration of a calibration in its metadata, found {error}"
        ) from None
    parameters, reference = build_parameters(LoadedConfig(config, path, {}))
    columns = [table[name].to_numpy() for name in parameters.names]
    weights = table["weight"].to_numpy()
    with np.errstate(divide="ignore"):
        has_scale = config.units.length != NO_LENGTH
        return Posterior(parameters, reference, np.column_stack(columns), np.log(weights), has_scale)


def posterior_figures(posterior: Posterior, true: list[Camera]) -> dict[str, Any]:
    """NEES of the mean, and which parameters' 90 % intervals hold the truth."""
    parameters = posterior.parameters
    mean, covariance = weighted_mean_covariance(posterior.particles, posterior.log_weights)
    truth = parameters.difference(in_frame(posterior, parameters.build(mean), true))
    levels, weights = [0.5 - CREDIBLE / 2, 0.5 + CREDIBLE / 2], np.exp(posterior.log_weights)
    low, high = np.quantile(posterior.particles, levels, axis=0, method="inverted_cdf", weights=weights)
    inside = (low <= truth) & (truth <= high)
    std = np.sqrt(np.diag(covariance))
    nees = normalised_error_squared(truth - mean, covariance)
    return {
        "nees": finite_or_none(nees / parameters.size),
        "covered_90": float(inside.mean()),
        "parameters": {
            name: {"error": float(mean[i] - truth[i]), "std": float(std[i]), "covered_90": bool(inside[i])}
            for i, name in enumerate(parameters.names)
        },
    }


def in_frame(posterior: Posterior, estimated: Sequence[Camera], true: Sequence[Camera]) -> Sequence[Camera]:
    """Return the true cameras in the frame and on the clock of a posterior: those of its reference camera.

    Where the posterior has no known length they also get its scale, which then is no error.
    """
    by_name = {camera.name: camera for camera in true}
    ordered = [by_name[camera.name] for camera in estimated]
    fixed, reference = estimated[posterior.reference], ordered[posterior.reference]
    if any(camera.pose.path is not None for camera in ordered):
        return ordered  # known trajectories have one frame
    scale = 1.0
    if not posterior.has_scale:
        found, truth = ([camera.pose for camera in cameras] for cameras in (estimated, ordered))
        scale = pose_errors(found, truth, posterior.reference).common_scale
    if scale == 1.0 and fixed.pose == reference.pose and fixed.clock == reference.clock:
        return ordered
    rotation, at_s = fixed.pose.rotation.T @ reference.pose.rotation, reference.clock.offset_s
    shift, rate = fixed.clock.offset_s - at_s, fixed.clock.rate / reference.clock.rate
    translation = fixed.pose.center - scale * rotation @ reference.pose.center
    registration = Registration(rotation, translation, scale, at_s, shift, rate, 0)
    return [moved_camera(camera, registration) for camera in ordered]
