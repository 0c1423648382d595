"""What a page needs of a ``report.json``, as types: a report of another shape is refused where it is read.

What a page does not show is not stated here, and may hold anything.
"""

from typing import Annotated, Any, NotRequired, TypedDict

from msgspec import Meta

_Numbers = dict[str, float | None]


class _Detector(TypedDict):
    sigma_px: NotRequired[list[float] | None]


class _Clock(TypedDict):
    offset_s: NotRequired[float | None]
    rate: NotRequired[float | None]


class _DescribedCamera(TypedDict):
    clock: NotRequired[_Clock | None]
    detector: NotRequired[_Detector | None]


class _Config(TypedDict):
    cameras: NotRequired[dict[str, _DescribedCamera] | None]
    filter: NotRequired[dict[str, Any] | None]


class _Record(TypedDict):
    config: _Config
    inputs: dict[str, str]
    seed: int | None


class _Finding(TypedDict):
    name: str
    status: str
    camera: str | None
    message: str
    remedy: str | None


class _Report(TypedDict):
    provenance: _Record
    length_unit: NotRequired[str | None]
    checks: NotRequired[list[_Finding]]


class _CameraFigures(TypedDict):
    frames: int
    detections: int
    explained_detections: float
    explained_share: float | None
    residuals: int
    residual_rms_px: float | None
    residual_mean_px: tuple[float, float] | None
    residual_ratio: NotRequired[float | None]


class _TrackFigures(TypedDict):
    track_id: int
    first_s: float
    last_s: float
    n_detections: dict[str, int]
    mean_existence: float | None
    mean_speed: NotRequired[float | None]
    mean_position_std: NotRequired[float | None]


class _Figures(TypedDict):
    tracks: NotRequired[list[_TrackFigures] | int]
    cameras: NotRequired[dict[str, _CameraFigures] | None]
    log_likelihood: NotRequired[float]
    cameras_part: NotRequired[_Numbers | None]


class _DetectorsUsed(TypedDict):
    cameras: NotRequired[dict[str, _Detector | None]]


class _Tracking(_Report, _Figures):
    detectors: NotRequired[_DetectorsUsed | None]


class _Pose(TypedDict):
    rotation_std_deg: float
    direction_std_deg: float
    center_std: float


class _Estimate(TypedDict):
    name: str
    unit: str
    prior_std: float
    mean: float | None
    std: float
    posterior_over_prior_std: float
    determined_by_data: bool


class _Direction(TypedDict):
    posterior_over_prior_std: float
    direction: dict[str, float]


class _Observability(TypedDict):
    directions: NotRequired[list[_Direction] | None]


class _Calibration(_Report):
    status: str
    reason: NotRequired[str | None]
    cameras: NotRequired[dict[str, _Pose] | None]
    parameters: NotRequired[list[_Estimate]]
    scale: NotRequired[dict[str, Any] | None]
    observability: NotRequired[_Observability | None]
    detectors: NotRequired[_DetectorsUsed | None]
    tracking: NotRequired[_Figures]


class _Ospa(TypedDict):
    order: Annotated[float, Meta(ge=1)]
    cutoff: Annotated[float, Meta(gt=0)]
    base: str
    mean: float | None


class _Consistency(TypedDict):
    position: float | None
    without_cameras: NotRequired[float | None]


class _Evaluation(_Report):
    ospa: _Ospa
    gospa: _Numbers
    rmse: _Numbers
    nees: _Consistency
    identity_switches: int | None


#: By the command that wrote the report.
SHAPES: dict[str, Any] = {"track": _Tracking, "calibrate": _Calibration, "evaluate": _Evaluation}
