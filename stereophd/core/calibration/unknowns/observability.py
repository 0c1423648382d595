"""The posterior of a calibration: spreads of poses, and which directions of the parameter space the data determine."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import LENGTH, LENGTH_PER_SECOND, MOVES
from stereophd.core.calibration.unknowns.quantities.pose import CENTER, ROTATION
from stereophd.core.calibration.unknowns.scale import log_scale
from stereophd.core.numerics.covariance_factors import covariance_factor

# A direction whose posterior standard deviation is above this part of the prior's is not determined by the data.
UNDETERMINED_RATIO = 0.7
# An undetermined direction of lenses, images, clocks or shutters is forgiven if one posterior standard deviation of it
# moves tracks by less than this part of their distance.
HARMLESS_MOVE = 0.02
# Draws of the posterior have at least this part of the optimum's scale.
LEAST_SCALE = 0.05
DETERMINED, PARTLY, UNDETERMINED = "determined", "partly determined", "undetermined"


@dataclass(frozen=True)
class Observability:
    """Directions of the parameter space, best determined first.

    The posterior covariance is compared with the prior's: with P = D^-1 S D^-1 and D the prior standard
    deviations, the eigenvectors of P are the directions, and the roots of its eigenvalues the ratios of
    posterior to prior standard deviation along them.
    """

    ratios: Array  # (m,): Posterior over prior standard deviation, increasing
    directions: Array  # (m, m): Unit vectors in units of prior standard deviations, one per row
    parameter_ratios: Array  # (m,): Posterior over prior standard deviation of each parameter
    scale_ratio: float  # The same ratio for the logarithm of the scene's scale; NaN where the scale is not free
    # What the data added to the prior: half the logarithm (base 2) of the ratio of determinants.
    information_bits: float
    # `DETERMINED` if nothing but the scale keeps a ratio above `UNDETERMINED_RATIO`; `PARTLY` if at least half of the
    # directions do not; else `UNDETERMINED`.
    status: str
    # (m,): Part of their distance by which one posterior standard deviation along each undetermined direction moves
    # tracks.
    open_moves: Array


def observability(
    parameters: ParameterSet,
    reference: int,
    values: Array,
    covariance: Array,
    moves: Callable[[Array], float] | None = None,
) -> Observability:
    """Compare a posterior (values (m,), covariance (m, m)) with the prior.

    With `moves`, the share of their distance by which a step of the values moves tracks, undetermined directions of
    lenses and images count where they matter.
    """
    std = parameters.prior_std
    whitened = covariance / np.outer(std, std)
    eigenvalues, vectors = np.linalg.eigh((whitened + whitened.T) / 2.0)
    ratios = np.sqrt(np.maximum(eigenvalues, 0.0))
    directions = vectors.T * np.sign(vectors.T[np.arange(len(std)), np.abs(vectors.T).argmax(axis=1)])[:, None]
    scale_ratio = np.nan
    allowed = 0
    _, gradient = log_scale(parameters, reference, values)
    if gradient.any():
        # the data determine the shape of the cameras, so that the prior of each centre is one of the common scale
        prior = float(gradient @ gradient) ** 2 / float((gradient**2 / std**2).sum())
        scale_ratio = min(float(np.sqrt(max(float(gradient @ covariance @ gradient), 0.0) / prior)), 1.0)
        allowed = int(scale_ratio > UNDETERMINED_RATIO)
    # of lenses, clocks and shutters the prior may be all that is known; poses must come from the data
    posed = np.array([p.quantity.of_the_frame and p.quantity.affects == MOVES for p in parameters.parameters])
    posed |= ~posed.any()
    needed = np.sqrt(np.maximum(np.linalg.eigvalsh(whitened[np.ix_(posed, posed)]), 0.0))
    open_directions = int((needed > UNDETERMINED_RATIO).sum())
    status = PARTLY if open_directions <= len(needed) // 2 else UNDETERMINED
    open_moves = np.zeros(len(ratios))
    if moves is not None:
        for number in np.flatnonzero(ratios > UNDETERMINED_RATIO):
            open_moves[number] = moves(ratios[number] * directions[number] * std)
    if open_directions <= allowed:
        status = DETERMINED if open_moves.max(initial=0.0) <= HARMLESS_MOVE else PARTLY
    bits = -0.5 * float(np.log2(np.maximum(eigenvalues, 1e-300)).sum())
    own = np.sqrt(np.diag(covariance)) / std
    return Observability(ratios, directions, own, scale_ratio, bits, status, open_moves)


def laplace_draws(
    parameters: ParameterSet, reference: int, values: Array, covariance: Array, count: int, rng: np.random.Generator
) -> Array:
    """Draw (count, m) from the posterior of an optimum and its covariance, which is normal except along the scale.

    If the scale is free, the data determine the directions of the cameras, and the centres lie in a cone: at a larger
    scale they are spread as much wider. A step z ~ N(0, S) is split, with the gradient g of log s, into a part that
    changes the scale and a part that does not,

        z = a S g / (g^T S g) + w,    a = g^T z,    g^T w = 0,

    and the part of w that moves centres is multiplied by the factor 1 + a on the scale.
    """
    steps = rng.standard_normal((count, parameters.size)) @ covariance_factor(covariance).T
    _, gradient = log_scale(parameters, reference, values)
    if not gradient.any():
        return np.asarray(values + steps)
    amount = steps @ gradient
    along = covariance @ gradient / (gradient @ covariance @ gradient)
    rest = steps - amount[:, None] * along
    # a scene turned inside out does not go with the data
    amount = np.maximum(amount, LEAST_SCALE - 1.0)
    lengths = np.array([parameter.unit in (LENGTH, LENGTH_PER_SECOND) for parameter in parameters.parameters])
    rest[:, lengths] *= 1.0 + amount[:, None]
    return np.asarray(values + amount[:, None] * along + rest)


@dataclass(frozen=True)
class PoseSpread:
    """Root mean square errors of the pose of a camera that follow from a covariance of the parameters."""

    rotation: float  # Standard deviation of the rotation, rad
    direction: float  # Standard deviation of the direction of the translation from the reference, rad
    scale: float  # Standard deviation of the logarithm of its length
    center: float  # Length


def pose_spread(parameters: ParameterSet, reference: int, values: Array, covariance: Array, camera: str) -> PoseSpread:
    """Spread of the pose of a camera under values (m,) with covariance (m, m)."""
    cameras = {c.name: c for c in parameters.build(values)}
    offset = cameras[camera].pose.center - parameters.cameras[reference].pose.center
    distance = float(np.linalg.norm(offset))
    center = _block(parameters.index(camera, CENTER), covariance)
    rotation = _block(parameters.index(camera, ROTATION), covariance)
    if distance == 0.0:
        return PoseSpread(_root_trace(rotation), np.nan, np.nan, _root_trace(center))
    unit = offset / distance
    across = (np.eye(3) - np.outer(unit, unit)) / distance
    return PoseSpread(
        _root_trace(rotation),
        _root_trace(across @ center @ across),
        float(np.sqrt(unit @ center @ unit)) / distance,
        _root_trace(center),
    )


def posed_cameras(parameters: ParameterSet) -> list[str]:
    """Names of the cameras whose pose is unknown, in the order of the parameters."""
    return list(dict.fromkeys(p.camera for p in parameters.parameters if p.name in CENTER + ROTATION))


def _block(columns: NDArray[np.int64], covariance: Array) -> Array:
    """Covariance (3, 3) of three quantities, zero where one is known."""
    used = columns >= 0
    block = np.zeros((3, 3))
    block[np.ix_(used, used)] = covariance[np.ix_(columns[used], columns[used])]
    return block


def _root_trace(matrix: Array) -> float:
    return float(np.sqrt(max(np.trace(matrix), 0.0)))
