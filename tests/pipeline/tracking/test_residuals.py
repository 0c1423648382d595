"""What successive detections show together of the errors of tracks."""

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.pipeline.checks.finding import Finding
from stereophd.pipeline.checks.run_figures import check_errors
from stereophd.pipeline.tracking.residuals import SeenTrack, TrackErrors, residuals_of
from tests.scenes import build_camera

CAMERAS = [build_camera("left", (-2.0, 0.0, -5.0)), build_camera("right", (2.0, 0.0, -5.0))]
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
    (found,) = check_errors(summary, (), True)
    assert (found.status, found.cause) == ("ok" if cause is None else "warning", cause)
    assert found.change == ("motion.acceleration_std=estimate" if cause == "acceleration_std" else None)
    doubt = Finding("geometry.residuals", "warning", "a clock is off")
    (found,) = check_errors(summary, (doubt,), False)
    assert found.status == ("ok" if cause is None else "not checked")
    (found,) = check_errors(summary, (), False)
    assert found.change is None


def test_nothing_is_checked_without_detections() -> None:
    (found,) = check_errors({"track_errors": TrackErrors().report({})}, (), True)
    assert found.status == "not checked"
