"""The paper's single-object experiments (sections VIII-A and VIII-B), lengths in cm."""

from __future__ import annotations

import math

import numpy as np

from stereophd.core.disparity.events import Rig, make_rig
from stereophd.core.disparity.prior import DisparityPrior, InitialPrior
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from stereophd.experiments.single_object import SingleObjectProblem

SIGMA = math.sqrt(2.0)


def camera(name: str, x: float, yaw: float, readout_s: float = 0.0, **intrinsics: float) -> Camera:
    """A camera of Table I on the x axis, turned about y."""
    values = {"fx": 8.0 / 8.9e-3, "fy": 8.0 / 9.0e-3, "cx": 400.0, "cy": 300.0} | intrinsics
    pose = Pose(rotation_from_vector(np.array([0.0, yaw, 0.0])), np.array([x, 0.0, 0.0]))
    detector = Detector((SIGMA, SIGMA), 1.0, 0.0)
    return Camera(name, 800, 600, **values, pose=pose, lens=Lens("none"), detector=detector, readout_s=readout_s)


def rig(*cameras: Camera) -> Rig:
    return make_rig(cameras, 1.0, "horizontal")


def table_two(depth: float, mean: float, variance: float) -> SingleObjectProblem:
    cameras = rig(camera("left", 0.0, 0.0), camera("right", 30.0, math.pi / 12))
    return at_rest(cameras, depth, DisparityPrior(mean_px=mean, std_px=math.sqrt(variance)), 2)


def at_rest(cameras: Rig, depth: float, prior: DisparityPrior, looks: int) -> SingleObjectProblem:
    """An object straight ahead of the first of two cameras, which observe it by turns."""
    start = np.array([0.0, 0.0, depth, 0.0, 0.0, 0.0])
    return SingleObjectProblem(
        cameras, start, Static(), InitialPrior(disparity=prior), np.zeros(looks), np.arange(looks) % 2
    )


def figure_ten(steps: int = 20) -> SingleObjectProblem:
    cameras = rig(camera("left", 0.0, 0.0), camera("right", 80.0, math.pi / 4))
    return at_rest(cameras, 150.0, DisparityPrior(mean_px=12.5, std_px=4.2), steps)


def figure_eleven(steps: int = 300) -> SingleObjectProblem:
    cameras = rig(camera("left", -20.0, -math.pi / 12), camera("right", 20.0, math.pi / 12))
    return SingleObjectProblem(
        cameras,
        np.array([0.0, 0.0, 100.0, 0.0, 0.0, 6.0]),
        ConstantVelocity([0.05, 0.05, 0.1]),
        InitialPrior(disparity=DisparityPrior(mean_px=12.5, std_px=4.2), velocity_std=3.0),
        np.repeat(0.5 * np.arange(steps), 2),
        np.tile([0, 1], steps),
    )
