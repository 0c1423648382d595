"""What successive detections show together of the errors of tracks."""

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.pipeline.checks.finding import Finding, once_mended
from stereophd.pipeline.checks.run_checks import check_errors
from stereophd.pipeline.tracking.associations import Associated
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.residuals import SeenTrack, TrackErrors, residuals_of
from tests.scenes import build_camera

NOISE = (2.0, 1.2)
CAMERAS = [build_camera(name, (x, 0.0, -5.0), noise=NOISE) for name, x in (("left", -2.0), ("right", 2.0))]
# So many tracks, which end before their objects leave the view.
ACCELERATION, STEP_S, COUNT, TRACKS = 0.3, 0.02, 200, 12


def filtered(stated: float, errors: Array, rng: np.random.Generator) -> list[SeenTrack]:
    """Track one object by a Kalman filter of this acceleration, from detections of one camera after the other."""
    true, tracked = (ConstantVelocity(value).transition(STEP_S) for value in (ACCELERATION, stated))
    truth = np.concatenate([rng.normal(0.0, 0.2, 3), np.zeros(3)])
    state, covariance, out = truth.copy(), 1e-4 * np.eye(6), []
    for k in range(COUNT):
        camera = CAMERAS[k % 2]
        truth = rng.multivariate_normal(*true.predict(truth, np.zeros((6, 6))), method="cholesky")
        pixels = camera.project(truth[None, :3])[0] + errors[k] * np.asarray(camera.detector.sigma)
        state, covariance = tracked.predict(state, covariance)
        seen = SeenTrack(camera.name, 0, k * STEP_S, state, covariance[:3, :3], pixels)
        found = residuals_of(camera, [seen])
        slopes = np.hstack([found.jacobians[0], np.zeros((2, 3))])
        spread = slopes @ covariance @ slopes.T + np.diag(np.asarray(camera.detector.sigma) ** 2)
        gain = np.linalg.solve(spread, slopes @ covariance).T
        state, covariance = state + gain @ found.residuals[0], covariance - gain @ spread @ gain.T
        out.append(seen._replace(state=state, covariance=covariance[:3, :3]))
    return out


def lasting(rng: np.random.Generator) -> Array:
    """Errors (n, 2) of twice the variance of white ones beside them, that last for some frames of a camera."""
    white, out = rng.normal(size=(COUNT, 2)), np.zeros((COUNT, 2))
    for k in range(2, COUNT):
        out[k] = 0.9 * out[k - 2] + np.sqrt(1.0 - 0.9**2) * rng.normal(size=2)
    return np.asarray(white + np.sqrt(2.0) * out)


@pytest.mark.parametrize(
    ("stated", "lasts", "cause"),
    [
        (ACCELERATION, False, None),
        (3.0 * ACCELERATION, False, None),
        (ACCELERATION / 5.0, False, "acceleration_std"),
        (ACCELERATION, True, "errors_last"),
    ],
)
def test_tracks_that_are_too_sure_are_named(stated: float, lasts: bool, cause: str | None) -> None:
    rng = np.random.default_rng(2002000)
    by_name: dict[str, Camera] = {camera.name: camera for camera in CAMERAS}
    errors = TrackErrors()
    for track in range(TRACKS):
        noise = lasting(rng) if lasts else rng.normal(size=(COUNT, 2))
        errors.waiting += [one._replace(track_id=track) for one in filtered(stated, noise, rng)]
    summary = {"track_errors": errors.report(by_name)}
    if stated == ACCELERATION and not lasts:  # the products have the variance that they should
        for sums in (errors.same_camera, errors.other_camera):
            assert sums.squares / sums.variances == pytest.approx(1.0, abs=0.25)
    (found,) = check_errors(summary, True)
    assert (found.status, found.cause) == ("ok" if cause is None else "warning", cause)
    assert found.change == ("motion.acceleration_std=estimate" if cause == "acceleration_std" else None)
    doubt = Finding("geometry.residuals", "warning", "a clock is off")
    (found,) = once_mended(check_errors(summary, False), (doubt,))
    assert found.status == ("ok" if cause is None else "not checked")
    (found,) = check_errors(summary, False)
    assert found.change is None


@pytest.mark.parametrize("tracks", [10, 1300])
def test_every_successive_detection_of_a_track_counts_once(tracks: int) -> None:
    """Also where a frame has more tracks than residuals are computed at a time."""
    events, ids, rng = 8, np.arange(tracks), np.random.default_rng(5)
    states = np.column_stack([rng.uniform(-1.0, 1.0, (tracks, 3)), np.zeros((tracks, 3))])
    estimates = Estimates(ids, states, np.tile(1e-5 * np.eye(6), (tracks, 1, 1)), np.ones(tracks), ids)
    errors, by_name = TrackErrors(), {camera.name: camera for camera in CAMERAS}
    for event in range(events):
        camera = CAMERAS[event % 2]
        pixels = camera.project(states[:, :3]) + rng.normal(size=(tracks, 2)) * NOISE
        seen = Associated(float(event), camera.name, event, pixels, ids, ids, np.ones(tracks))
        nothing = Info(0.0, 0.0, 0, np.empty(0, dtype=np.int64))
        errors.add(
            Record(float(event), camera.name, event, tracks, 0, nothing, estimates, associations=(seen,)), by_name
        )
    report = errors.report(by_name)
    counts = [report[key]["pairs"] / tracks for key in ("other_camera", "same_camera")]
    assert counts == pytest.approx([events - 1.0, events - 2.0], rel=0.01)  # but for outliers


@pytest.mark.parametrize(
    ("same", "other", "cause", "value"),
    [
        ((1.0, 20.0), (-0.3, -6.0), "errors_last", 1.0), ((1.0, 20.0), (0.5, 10.0), "acceleration_std", 1.0),
        ((0.1, 2.0), (1.5, 30.0), "errors_shared", 1.5), ((0.9, 3.0), (1.0, 4.1), "acceleration_std", 1.0),
        ((1.0, 20.0), (6.0, 2.0), "acceleration_std", 1.0),
    ],
)  # fmt: skip
def test_what_cameras_show_of_each_other_tells_whose_errors_last(
    same: tuple[float, float], other: tuple[float, float], cause: str, value: float
) -> None:
    """Of a camera that is in the log under two names both agree with each other, and neither with itself.

    What few pairs show, with large standard errors, neither decides nor is stated.
    """
    sums = {
        key: {"pairs": 1000, "excess": excess, "standard_errors": errors}
        for key, (excess, errors) in (("same_camera", same), ("other_camera", other))
    }
    (found,) = check_errors({"track_errors": sums}, True)
    assert (found.status, found.cause, found.value) == ("warning", cause, value)


def test_estimates_that_may_be_behind_the_camera_show_nothing() -> None:
    """Where a step within the covariance ends behind it there is no derivative: nothing is computed from it."""
    camera = build_camera("back", (0.0, 0.0, 5.0), (0.0, np.pi, 0.0), noise=NOISE)
    errors, state, pixels = TrackErrors(), np.zeros(6), camera.project(np.zeros((1, 3)))[0] + 0.1
    for time_s in range(4):
        for track_id, variance in enumerate((1e-5, 1e4)):
            errors.waiting.append(SeenTrack("back", track_id, float(time_s), state, variance * np.eye(3), pixels))
    with np.errstate(all="raise"):
        report = errors.report({"back": camera})
    assert report["same_camera"]["pairs"] == 3


def test_nothing_is_checked_without_detections() -> None:
    (found,) = check_errors({"track_errors": TrackErrors().report({})}, True)
    assert found.status == "not checked"
