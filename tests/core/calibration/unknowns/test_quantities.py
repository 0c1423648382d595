"""Every calibration quantity: apply and difference, commuting values, derivatives for every lens model, entries."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from stereophd.config.calibration import CameraPrior
from stereophd.core.calibration.unknowns.quantities.base import TIMES, Quantity
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import Sights, view_of
from stereophd.core.calibration.unknowns.quantities.pose import Center, Rotation
from stereophd.core.calibration.unknowns.quantities.registry import component_names, quantities, quantity_of
from stereophd.core.geometry.camera import Camera, Clock, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.geometry.rotations import left_jacobians, rotations
from stereophd.core.geometry.trajectory import BodyTrajectory, MountedPath

LENSES = {
    "none": Lens(),
    "radial": Lens("radial", k1=-0.1),
    "brown_conrady": Lens("brown_conrady", k1=-0.2, k2=0.1, p1=0.01, p2=-0.02, k3=0.03, k4=0.02, k5=0.01, k6=0.005),
    "fisheye": Lens("fisheye", k1=0.05, k2=-0.02, k3=0.01, k4=-0.003),
}
# Size of a typical value of each component, in its unit.
SIZES = {
    "center": 0.5, "rotation": 0.2, "focal": 0.3, "aspect": 0.02, "principal_point": 15.0, "distortion": 0.01,
    "clock_offset": 0.5, "clock_rate": 1e-3, "readout": 0.02, "velocity": 0.3, "rotation_rate": 0.05,
    "mount_center": 0.4, "mount_rotation": 0.2,
}  # fmt: skip


def make_camera(lens: str = "brown_conrady", moving: bool = True, mounted: bool = False) -> Camera:
    """A camera of which nothing is zero, at rest, moving steadily, or mounted on a body of known trajectory."""
    rates = ((0.1, -0.2, 0.05), (0.02, -0.03, 0.04)) if moving else ()
    pose = Pose(rotation_from_vector([0.1, -0.3, 0.2]), [1.0, -2.0, 0.5], *rates, time_s=2.0 if moving else 0.0)
    pose = Pose.following(mounted_path(), 2.0) if mounted else pose
    return Camera(
        "one", 800, 600, 700.0, 690.0, 410.0, 305.0, pose, LENSES[lens], Detector((1.0, 1.0), 0.9, 1.0),
        clock=Clock(0.3, 1.001), readout_s=0.015,
    )  # fmt: skip


def mounted_path() -> MountedPath:
    """A camera on a body that sways and turns gently between random poses."""
    rng = np.random.default_rng(11)
    vectors = 0.1 * rng.standard_normal((12, 3))
    quaternions = np.column_stack([np.ones(12), 0.5 * vectors])
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    poses = np.column_stack([np.arange(12.0) - 2.0, 0.2 * rng.standard_normal((12, 3)), quaternions])
    return MountedPath(BodyTrajectory(poses), rotation_from_vector([0.05, -0.1, 0.1]), [0.2, -0.1, 0.3])


def camera_for(quantity: Quantity, lens: str = "brown_conrady", moving: bool = True) -> Camera:
    """A camera that has the quantity."""
    return make_camera(lens, moving, mounted=quantity.name.startswith("mount"))


def draw(quantity: Quantity, camera: Camera, seed: int = 1) -> np.ndarray:
    """Values of a quantity, zero where the camera lacks the component."""
    values = SIZES[quantity.name] * np.random.default_rng(seed).uniform(-1.0, 1.0, len(quantity.components))
    return np.where(np.isin(quantity.components, quantity.available(camera)), values, 0.0)


members = pytest.mark.parametrize("quantity", quantities(), ids=lambda quantity: quantity.name)


@members
@pytest.mark.parametrize("lens", LENSES)
def test_difference_finds_what_was_applied(quantity: Quantity, lens: str) -> None:
    camera = camera_for(quantity, lens)
    values = draw(quantity, camera)
    assert values.any() or quantity.name == "distortion"
    moved = quantity.apply(camera, values)
    np.testing.assert_allclose(quantity.difference(camera, moved), values, atol=1e-12)
    back = quantity.apply(moved, -values)
    for other in quantities():
        np.testing.assert_allclose(other.difference(camera, back), 0.0, atol=1e-10)
        if other is not quantity:
            np.testing.assert_allclose(other.difference(camera, moved), 0.0, atol=1e-10)


@pytest.mark.parametrize("mounted", [False, True])
def test_the_order_of_quantities_does_not_matter(mounted: bool) -> None:
    camera = make_camera(mounted=mounted)
    for one, other in itertools.combinations(quantities(), 2):
        first, second = draw(one, camera, 2), draw(other, camera, 3)
        there = other.apply(one.apply(camera, first), second)
        back = one.apply(other.apply(camera, second), first)
        for quantity in quantities():
            np.testing.assert_allclose(quantity.difference(there, back), 0.0, atol=1e-10)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("moving", [False, True])
def test_second_derivatives_by_the_point_are_those_of_first_ones(lens: str, moving: bool) -> None:
    camera, rng = make_camera(lens, moving), np.random.default_rng(5)
    count, step = 20, 1e-5
    # some of the points lie beyond the radius at which a lens folds back
    ahead = np.column_stack([rng.uniform(-9.0, 9.0, (count, 2)), rng.uniform(2.0, 9.0, count)])
    world, pulls, when = camera.pose.to_world(ahead), rng.standard_normal((count, 2)), np.full(count, 3.0)

    def slopes(points: np.ndarray) -> np.ndarray:
        return np.einsum("nr,nra->na", pulls, view_of(camera, points, 0.0 * points, when, when, when).by_world)

    numeric = np.stack([(slopes(world + step * e) - slopes(world - step * e)) / (2.0 * step) for e in np.eye(3)], 1)
    sights = Sights.of((camera,), np.zeros(count, dtype=np.int64), when)
    seen = sights.project(world)
    found = np.einsum("nr,nrab->nab", pulls, sights.bends(seen.points, seen.ahead))
    np.testing.assert_allclose(found, numeric, atol=1e-5 * np.abs(numeric).max())


def test_a_rig_is_seen_as_its_cameras_one_by_one() -> None:
    """Cameras of all lenses, at rest, moving without a turn, turning and mounted, one of them without a row."""
    rng, count = np.random.default_rng(6), 120
    rig = [
        make_camera(lens, moving, mounted)
        for lens in LENSES
        for moving, mounted in ((False, False), (True, False), (False, True))
    ]
    rig += [replace(rig[0], pose=Pose(rig[0].pose.rotation, rig[0].pose.center, velocity=(0.3, 0.1, 0.0)))] * 2
    of_row, times = rng.integers(0, len(rig) - 1, count), rng.uniform(-3.0, 9.0, count)
    world = rig[0].pose.to_world(np.column_stack([rng.uniform(-3.0, 3.0, (count, 2)), rng.uniform(-1.0, 9.0, count)]))
    velocities = rng.normal(0.0, 0.3, (count, 3))
    sights = Sights.of(tuple(rig), of_row, times)
    found = sights.project(world)
    bends = sights.bends(found.points, found.ahead)
    for number, camera in enumerate(rig):
        here = np.flatnonzero(of_row == number)
        view = sights.view(number, here, found, velocities, times, times, times)
        alone = view_of(camera, world[here], velocities[here], times[here], times[here], times[here])
        for name in ("ahead", "visible", "elapsed", "points", "distorted", "pixels", "by_point", "by_world", "drift"):
            np.testing.assert_allclose(getattr(view, name), getattr(alone, name), rtol=1e-9, atol=1e-9)
        moved = world[here] - camera.pose.motions(times[here]).centers
        expected = np.einsum("nij,nj->ni", camera.pose.motions(times[here]).rotations, moved)
        np.testing.assert_allclose(view.points, expected, atol=1e-9)
        one = Sights.of((camera,), np.zeros(len(here), dtype=np.int64), times[here])
        # else kernels are compiled once more
        assert all(values.flags.c_contiguous for values in (*sights.places.motions, *one.places.motions))
        seen = one.project(world[here])
        np.testing.assert_allclose(bends[here], one.bends(seen.points, seen.ahead), rtol=1e-9, atol=1e-9)


def test_what_lies_beyond_the_edge_of_a_lens_is_imaged_on_it() -> None:
    """The pixel goes on without a jump; it moves about the axis alone."""
    camera = replace(make_camera("radial", moving=False), pose=Pose(np.eye(3), np.zeros(3)))
    edge = camera.lens.max_radius
    ahead = np.array([[share * edge * 0.6, share * edge * 0.8, 1.0] for share in (1.0 - 1e-9, 1.0 + 1e-9, 1.5)])
    nothing = np.zeros(3)
    view = view_of(camera, ahead, 0.0 * ahead, nothing, nothing, nothing)
    assert view.ahead.all()
    np.testing.assert_array_equal(view.visible, [True, False, False])
    np.testing.assert_allclose(view.pixels, view.pixels[[0, 0, 0]], atol=1e-5)
    moved = np.einsum("nra,na->nr", view.by_world, ahead * [1.0, 1.0, 0.0])
    np.testing.assert_allclose(moved, 0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("quantity", "pose"),
    [
        (quantity, pose)
        for quantity in quantities()
        for pose in ("still", "moving", "mounted")
        if quantity.available(make_camera(mounted=pose == "mounted"))
    ],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
@pytest.mark.parametrize("lens", LENSES)
def test_derivative_is_that_of_finite_differences(quantity: Quantity, lens: str, pose: str) -> None:
    """Of a rolling shutter: the pose, too, is that of the time of the row, which clocks and readout move."""
    camera = make_camera(lens, moving=pose == "moving", mounted=pose == "mounted")
    rng = np.random.default_rng(4)
    count = 20
    log_times, rows = rng.uniform(0.0, 6.0, count), rng.uniform(0.0, 1.0, count)
    # cubics in the world, before the camera
    ahead = camera.pose.to_world(np.column_stack([rng.uniform(-2.0, 2.0, (count, 2)), rng.uniform(5.0, 9.0, count)]))
    velocity, bend = rng.normal(0.0, 0.1, (2, count, 3))
    centre = camera.clock.to_true(log_times)

    def seen(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        now = quantity.apply(camera, values)
        times = now.clock.to_true(log_times) + now.readout_s * rows
        since = (times - centre)[:, None]
        view = view_of(
            now, ahead + since * velocity + since**2 * bend, velocity + 2.0 * since * bend, times, log_times, rows
        )
        assert view.visible.all()
        return view.pixels, quantity.derivative(view, values)

    # away from zero, where left Jacobians differ from one
    values = draw(quantity, camera) * (0.3 if quantity.affects == TIMES else 1.0)
    pixels, derivative = seen(values)
    assert derivative.shape == (count, 2, len(quantity.components))
    for k, name in enumerate(quantity.components):
        if name not in quantity.available(camera):
            continue
        step = np.zeros(len(values))
        step[k] = 1e-5 * SIZES[quantity.name]
        numeric = (seen(values + step)[0] - seen(values - step)[0]) / (2.0 * step[k])
        scale = max(float(np.abs(numeric).max()), 1.0)
        np.testing.assert_allclose(derivative[:, :, k], numeric, atol=2e-6 * scale)
    assert np.isfinite(pixels).all()


@pytest.mark.parametrize("pose", ["still", "moving", "mounted"])
@pytest.mark.parametrize("lens", LENSES)
def test_pulls_follow_values_as_pixels_and_their_derivatives_do(lens: str, pose: str) -> None:
    """At pixels, and along a line of points for each coordinate at the derivatives; also beyond the edge of a lens."""
    camera = make_camera(lens, moving=pose == "moving", mounted=pose == "mounted")
    rng, count, step = np.random.default_rng(7), 30, 1e-5
    ahead = np.column_stack([rng.uniform(-9.0, 9.0, (count, 2)), rng.uniform(2.0, 9.0, count)])
    times, rows = rng.uniform(0.0, 6.0, count), rng.uniform(0.0, 1.0, count)
    motions = camera.pose.motions(times)
    turns = np.broadcast_to(motions.rotations, (count, 3, 3))
    world = np.einsum("nba,nb->na", turns, ahead) + motions.centers
    velocities, pixels, lines = rng.normal(0.0, 0.3, (count, 3)), *rng.normal(0.0, 1.0, (2, count, 2, 3))
    sights = Sights.of((camera,), np.zeros(count, dtype=np.int64), times)
    seen = sights.project(world)
    later = rng.standard_normal(count)
    pull = sights.pull(seen, pixels[:, :, 0], lines, later, sights.bends(seen.points, seen.ahead))
    view = sights.view(0, slice(None), seen, velocities, times, times, rows)
    for quantity in quantities():
        if not quantity.available(camera):
            continue
        values = np.zeros(len(quantity.components))

        def derivative(points: np.ndarray, of: Quantity = quantity, at: np.ndarray = values) -> np.ndarray:
            return of.derivative(view_of(camera, points, velocities, times, times, rows), at)

        expected = np.einsum("nr,nrk->nk", pixels[:, :, 0], derivative(world))
        for r in (0, 1):
            ahead_of, behind = (derivative(world + sign * step * lines[:, r])[:, r] for sign in (1.0, -1.0))
            expected += (ahead_of - behind) / (2.0 * step)
        if quantity.affects == TIMES:
            expected += (later * {"clock_rate": times, "readout": rows}.get(quantity.name, 1.0))[:, None]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            quantity.pulled(view, pull, values), expected, atol=1e-6 * scale, err_msg=quantity.name
        )


@pytest.mark.parametrize("mounted", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_pixels_are_those_of_the_camera(lens: str, mounted: bool) -> None:
    camera = make_camera(lens, mounted=mounted)
    points = camera.pose.to_world(np.random.default_rng(5).uniform([-2, -2, 4], [2, 2, 9], (10, 3)))
    for time_s in (2.0, 5.0):
        still = np.zeros((10, 3))
        view = view_of(camera, points, still, np.full(10, time_s), np.full(10, time_s), np.zeros(10))
        np.testing.assert_allclose(view.pixels, camera.at(time_s).project(points), atol=1e-9)


@pytest.mark.parametrize("quantity", [Center(), Rotation()], ids=lambda q: q.name)
def test_packed_cameras_are_those_of_apply(quantity: Quantity) -> None:
    camera = make_camera(moving=False)
    values = np.stack([draw(quantity, camera, seed) for seed in range(3)])
    packed = np.repeat(camera.packed()[None], 3, axis=0)
    quantity.pack(packed, camera, values)
    for row, one in zip(packed, values, strict=True):
        np.testing.assert_allclose(row, quantity.apply(camera, one).packed(), atol=1e-12)


@members
def test_every_quantity_has_a_prior_and_unique_names(quantity: Quantity) -> None:
    assert quantity.prior in CameraPrior.model_fields
    assert CameraPrior.model_fields[quantity.prior].description == quantity.description
    assert all(quantity_of(name) is quantity for name in quantity.components)
    assert len(set(component_names())) == len(component_names())


@members
def test_the_entry_leads_back_to_the_camera(quantity: Quantity) -> None:
    from stereophd.io.cameras.models import CameraConfig
    from stereophd.io.cameras.writing import camera_config
    from stereophd.pipeline.calibration.configured_unknowns import with_quantities

    camera = camera_for(quantity)
    config = (
        camera_config(camera)
        if camera.pose.path is not None
        else CameraConfig.model_validate(
            {
                "image_size_px": (800, 600),
                "intrinsics": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
                "pose": {
                    "center": tuple(camera.pose.center.tolist()),
                    "rotation_matrix": tuple(map(tuple, camera.pose.rotation.tolist())),
                    "velocity": tuple(camera.pose.velocity.tolist()),
                    "rotation_rate_deg_s": tuple(np.degrees(camera.pose.rotation_rate).tolist()),
                    "time_s": camera.pose.time_s,
                },
                "detector": {"sigma_px": (1.0, 1.0), "p_detect": 0.9, "clutter_per_frame": 1.0},
                "distortion": {
                    "model": "brown_conrady",
                    **{n: getattr(camera.lens, n) for n in ("k1", "k2", "p1", "p2")},
                },
                "clock": {"offset_s": 0.3, "rate": 1.001},
                "readout_s": camera.readout_s,
            }
        )
    )
    start = config.build("one")
    moved = quantity.apply(start, draw(quantity, start))
    found = with_quantities({"one": config}, [moved])["one"].build("one")
    for other in quantities():
        np.testing.assert_allclose(other.difference(moved, found), 0.0, atol=1e-12)


def test_left_jacobians_and_rotations_at_small_and_large_angles() -> None:
    rng = np.random.default_rng(6)
    vectors = np.concatenate([1e-6 * rng.standard_normal((3, 3)), rng.standard_normal((5, 3)), np.zeros((1, 3))])
    for vector, turn, jacobian in zip(vectors, rotations(vectors), left_jacobians(vectors), strict=True):
        np.testing.assert_allclose(turn, rotation_from_vector(vector), atol=1e-14)
        step = 1e-6 * np.array([0.3, -0.5, 0.8])
        expected = rotation_from_vector(jacobian @ step) @ turn
        np.testing.assert_allclose(rotation_from_vector(vector + step), expected, atol=2e-12)
