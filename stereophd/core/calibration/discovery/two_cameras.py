"""Two cameras from nothing: hypotheses refined, and the distinct optima with the greatest gains."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.discovery.pair_fit import (
    PairFit,
    PairPrior,
    PairProblem,
    PairState,
    distance_of,
    straightened,
)
from stereophd.core.calibration.discovery.pair_search import PairSearch, make_grid
from stereophd.core.calibration.discovery.tracks import SlopeTracks
from stereophd.core.calibration.time_limit import within

# Hypotheses are refined in rounds: how many of the greatest gains each takes, and its tolerances, px. The last ones are
# below the noise of smoothed tracks, which right cameras fit to and others do not.
ROUNDS = ((24, (20.0, 10.0)), (8, (10.0, 5.0, 2.5, 1.25, 0.625, 0.3125)))
# Optima that are kept.
MOST_OPTIMA = 4
# First radial coefficients that are tried where a lens is unknown, and factors of focal lengths known worse than this.
LENSES, FOCAL_FACTORS, KNOWN_FOCAL = (0.0, -0.2, -0.4), (1.0, 0.7, 1.4), 0.1
# Optima are others if their rotations or directions differ by this, rad, or their offsets by so many steps of the grid.
OTHER_ANGLE, OTHER_STEPS = np.deg2rad(10.0), 2.0


@dataclass(frozen=True)
class PairResult:
    """Distinct optima of two cameras, the one whose points in front of both cameras gain most first."""

    fits: tuple[PairFit, ...]
    step: float  # of the offsets that were searched, s


@dataclass(frozen=True)
class Link:
    """Two cameras that are joined: an optimum, and what it and the nearest rival gain, another pose of the camera.

    Gains are those of the points in front of the cameras, of all pairs that agree, without what both poses share.
    """

    cameras: tuple[int, int]
    best: PairFit
    gains: tuple[float, float]  # of the optimum and of the other pose
    other: tuple[float, float]  # how far that is turned, rad, and how much later its clock is, s
    agreeing: int  # how many pairs turn the camera so: several close a loop
    opposed: int  # how many pairs turn it otherwise


def find_pair(
    found: SlopeTracks, cameras: tuple[int, int], prior: PairPrior, reach: float, rng: np.random.Generator
) -> PairResult:
    """Find two cameras from tracks, the second clock within `reach`, s, of its prior mean."""
    grid = make_grid(found, cameras, reach)
    problem = PairProblem(found, cameras, prior, grid.step)
    unknown = np.array(prior.lens_unknown, dtype=np.float64)
    lenses = [value * unknown for value in (LENSES if unknown.any() else LENSES[:1])]
    factors = FOCAL_FACTORS if max(prior.focal_std) > KNOWN_FOCAL else FOCAL_FACTORS[:1]
    free = np.array(prior.focal_std) > KNOWN_FOCAL
    starts: list[tuple[float, PairState]] = []
    most = ROUNDS[0][0]
    guesses = list(product(lenses, factors))
    for number, (lens, factor) in enumerate(guesses, start=1):
        within(f"hypotheses by lens and focal length {number} of {len(guesses)}")
        focal = np.where(free, factor, 1.0)
        tracks = _with_intrinsics(found, cameras, focal, lens)
        search = PairSearch(tracks, cameras, make_grid(tracks, cameras, reach))
        starts += [(one.score, problem.start(one, focal, lens)) for one in search.hypotheses(most, rng)]
    starts.sort(key=lambda start: -start[0])
    states, fits = [state for _, state in starts], []
    for number, (most, tolerances) in enumerate(ROUNDS, start=1):
        within(f"the best {min(most, len(states))} are fitted, round {number} of {len(ROUNDS)}")
        refined = [fit for state in states[:most] if (fit := problem.fitted(state, tolerances)) is not None]
        fits = _distinct(refined, grid.step)
        states = [fit.state for fit in fits]
    return _ordered(fits, grid.step)


def with_start(problem: PairProblem, pair: PairResult, state: PairState) -> PairResult:
    """Return the optima of two cameras with the one that is found from a state near it, if it is another one."""
    fit = problem.fitted(state, ROUNDS[-1][1])
    return pair if fit is None else _ordered(_distinct([*pair.fits, fit], problem.step), problem.step)


def _ordered(fits: Sequence[PairFit], step: float) -> PairResult:
    """Return distinct optima, those of the greatest gains, as a result."""
    return PairResult(tuple(sorted(fits, key=lambda fit: -fit.gain_in_front)[:MOST_OPTIMA]), step)


def _distinct(fits: Sequence[PairFit], step: float) -> list[PairFit]:
    """Return fits that differ from all of greater gain, the best first."""
    out: list[PairFit] = []
    for fit in sorted(fits, key=lambda fit: -fit.gain):
        if all(
            max(distance_of(fit.state, other.state)) > OTHER_ANGLE
            or abs(fit.state.offset_s - other.state.offset_s) > OTHER_STEPS * step
            for other in out
        ):
            out.append(fit)
    return out


def _with_intrinsics(found: SlopeTracks, cameras: Sequence[int], focal: Array, lenses: Array) -> SlopeTracks:
    """Return tracks whose slopes are those of other focal lengths and lenses of two cameras."""
    slopes, factors = found.tracks.pixels.copy(), found.focal.copy()
    of_entry = np.repeat(found.tracks.cameras, np.diff(found.tracks.first))
    for side, number in enumerate(cameras):
        rows = of_entry == number
        slopes[rows] = straightened(slopes[rows] / focal[side], float(lenses[side]))
        factors[number] *= focal[side]
    return replace(found, tracks=replace(found.tracks, pixels=slopes), focal=factors)
