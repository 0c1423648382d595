"""Two cameras from nothing: hypotheses refined, and the distinct optima with the greatest gains."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.discovery.pair_fit import (
    QUICK,
    TOLERANCES,
    PairFit,
    PairPrior,
    PairProblem,
    PairState,
    distance_of,
    straightened,
)
from stereophd.core.calibration.discovery.pair_search import PairSearch, make_grid
from stereophd.core.calibration.discovery.tracks import SlopeTracks
from stereophd.core.calibration.time_limit import told

# Hypotheses that are refined at the first tolerances, and of these at all; optima that are kept.
MOST_HYPOTHESES, REFINED, MOST_OPTIMA = 40, 10, 4
# First radial coefficients that are tried where a lens is unknown, and factors of focal lengths known worse than this.
LENSES, FOCAL_FACTORS, KNOWN_FOCAL = (0.0, -0.2, -0.4), (1.0, 0.7, 1.4), 0.1
# Optima are others if their rotations or directions differ by this, rad, or their offsets by so many steps of the grid.
OTHER_ANGLE, OTHER_STEPS = np.deg2rad(10.0), 2.0
# Least share of the points in front of both cameras.
LEAST_FRONT = 0.95


@dataclass(frozen=True)
class PairResult:
    """Optima of two cameras, the best first; those with points behind the cameras last."""

    cameras: tuple[int, int]
    fits: tuple[PairFit, ...]

    @property
    def best(self) -> PairFit:
        """The optimum of the greatest gain with the points in front of both cameras."""
        return self.fits[0]

    @property
    def gap(self) -> float:
        """Gain of the best over that of the next optimum with the points in front of both cameras."""
        others = [fit.gain for fit in self.fits[1:] if fit.front >= LEAST_FRONT]
        return self.best.gain / max(max(others, default=0.0), 1e-9)


def find_pair(
    found: SlopeTracks, cameras: tuple[int, int], prior: PairPrior, reach: float, rng: np.random.Generator,
    tell: Callable[[str], object],
) -> PairResult | None:  # fmt: skip
    """Find two cameras from tracks, the second clock within `reach`, s, of its prior mean; None where none pair.

    `tell` is told which step begins.
    """
    if min(len(found.of_camera(number)) for number in cameras) == 0:
        return None
    grid = make_grid(found, cameras, reach)
    problem = PairProblem(found, cameras, prior, grid.step)
    unknown = np.array(prior.lens_unknown, dtype=np.float64)
    lenses = [value * unknown for value in (LENSES if unknown.any() else LENSES[:1])]
    factors = FOCAL_FACTORS if max(prior.focal_std) > KNOWN_FOCAL else FOCAL_FACTORS[:1]
    free = np.array(prior.focal_std) > KNOWN_FOCAL
    starts: list[tuple[float, PairState]] = []
    for lens, factor in product(lenses, factors):
        focal = np.where(free, factor, 1.0)
        tracks = _with_intrinsics(found, cameras, focal, lens)
        search = PairSearch(tracks, cameras, make_grid(tracks, cameras, reach))
        hypotheses = search.hypotheses(MOST_HYPOTHESES, rng, tell)
        starts += [(one.score, problem.start(one, focal, lens)) for one in hypotheses]
    starts = sorted(starts, key=lambda start: -start[0])[:MOST_HYPOTHESES]
    each = told(starts, tell, "hypothesis")
    first = [fit for _, state in each if (fit := problem.fitted(state, TOLERANCES[:QUICK])) is not None]
    first.sort(key=lambda fit: -fit.gain)
    best = told(first[:REFINED], tell, "refined hypothesis")
    fits = [fit for one in best if (fit := problem.fitted(one.state, TOLERANCES[1:])) is not None]
    fits.sort(key=lambda fit: (fit.front < LEAST_FRONT, -fit.gain))
    distinct: list[PairFit] = []
    for fit in fits:
        if not any(_is_same(fit.state, other.state, grid.step) for other in distinct):
            distinct.append(fit)
    return PairResult(cameras, tuple(distinct[:MOST_OPTIMA])) if distinct else None


def _is_same(one: PairState, other: PairState, step: float) -> bool:
    turn, direction = distance_of(one, other)
    apart = abs(one.offset_s - other.offset_s)
    return max(turn, direction) <= OTHER_ANGLE and apart <= OTHER_STEPS * step


def _with_intrinsics(found: SlopeTracks, cameras: Sequence[int], focal: Array, lenses: Array) -> SlopeTracks:
    """Return tracks whose slopes are those of other focal lengths and lenses of two cameras."""
    slopes, factors = found.tracks.pixels.copy(), found.focal.copy()
    of_entry = np.repeat(found.tracks.cameras, np.diff(found.tracks.first))
    for side, number in enumerate(cameras):
        rows = of_entry == number
        slopes[rows] = straightened(slopes[rows] / focal[side], float(lenses[side]))
        factors[number] *= focal[side]
    return replace(found, tracks=replace(found.tracks, pixels=slopes), focal=factors)
