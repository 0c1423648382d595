"""How bodies move: as the motion model says, with a size that hardly changes, standing where there is a ground.

The lowest point of a body that stands is at a height e over the ground, an Ornstein-Uhlenbeck process of standard
deviation `ground.std`: its errors last for `GROUND_TIME_S`, so that frames that follow each other closely are not
counted as independent evidence of the ground.
"""

import math

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.bodies.outline import LOG_AXES, POSITION, STATE_SIZE, VELOCITY
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.motion.base import Motion

# Time constant of the height over the ground, s.
GROUND_TIME_S = 1.0
# Standard deviation of the logarithm of an extent after a second: bodies bend and turn.
SIZE_STD_PER_S = 0.02


def predict_bodies(
    states: Array, covariances: Array, dt: float, motion: Motion, shape: EllipsoidSettings
) -> tuple[Array, Array]:
    """Return states (n, 8) and covariances (n, 8, 8) after an interval dt, s."""
    step = motion.transition(dt)
    matrix, noise, drift = np.eye(STATE_SIZE), np.zeros((STATE_SIZE, STATE_SIZE)), np.zeros(STATE_SIZE)
    matrix[:6, :6], noise[:6, :6], drift[:6] = step.matrix, step.noise, step.drift
    noise[LOG_AXES, LOG_AXES] = SIZE_STD_PER_S**2 * abs(dt) * (np.eye(2) if shape.up is not None else 1.0)
    if shape.ground is None:
        return states @ matrix.T + drift, matrix @ covariances @ matrix.T + noise
    up, std = shape.direction, shape.ground.std
    kept = math.exp(-abs(dt) / GROUND_TIME_S)
    along = np.outer(up, up)
    level = np.eye(STATE_SIZE)
    level[POSITION, POSITION] = level[VELOCITY, VELOCITY] = np.eye(3) - along
    matrix, noise, drift = level @ matrix @ level, level @ noise @ level, level @ drift
    matrix[POSITION, POSITION] += kept * along
    noise[POSITION, POSITION] += (1.0 - kept**2) * std**2 * along
    noise[VELOCITY, VELOCITY] += (std / GROUND_TIME_S) ** 2 * along
    half = np.exp(states[:, LOG_AXES.start])
    predicted = states @ matrix.T + drift
    predicted[:, POSITION] += (1.0 - kept) * (half + up @ np.array(shape.ground.point))[:, None] * up
    slopes = np.broadcast_to(matrix, covariances.shape).copy()
    slopes[:, POSITION, LOG_AXES.start] = (1.0 - kept) * half[:, None] * up
    # the middle rises with a body that grows
    grown = np.broadcast_to(np.eye(STATE_SIZE), covariances.shape).copy()
    grown[:, POSITION, LOG_AXES.start] = half[:, None] * up
    return predicted, slopes @ covariances @ slopes.swapaxes(1, 2) + grown @ noise @ grown.swapaxes(1, 2)
