"""A few distances of one object among many of different objects, whose density is known with an error.

The likelihood of a noise is that of the numbers of distances, integrated over the number of partners (at most one of a
detection) and over the errors of the density: where strangers hide the partners, it is nearly even, and what small
noise cannot hide speaks against small noise. The density is wrong by a sum of bumps of all widths, with a prior of
their size: over a part of the distance that chance bridges, densities of different objects are even. Distances beyond
the median of chance tell nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array

# Noises that are tried, px, and borders between classes of distances, px.
NOISES = np.geomspace(0.03, 300.0, 90)
BORDERS = np.concatenate([[0.0], np.geomspace(0.01, 10_000.0, 110)])
# Bumps of the density of distances of different objects, each half as wide as the one before, and the probability that
# no detection has a partner.
BUMPS, STRANGERS = 8, 0.1
# Rounds of a fit, and by how much one changes logarithms and partners at most.
ROUNDS, MOST_CHANGE = 12, (1.0, 5.0)
# Detections that have a partner, at most.
MOST_PARTNERS = 0.95
# Log-likelihood that one mixture may weigh: detections of one object are not independent, and chance may look like
# noise of another size.
MOST_EVIDENCE = 20.0
# Distances of chance, number and share, below which their density counts as even.
EVEN_COUNT, EVEN_SHARE = 50, 0.001


@dataclass(frozen=True)
class DistanceKind:
    """What distances are measured, and how well the density of those of different objects is known."""

    dimensions: int  # 1 of distances from a line, 2 of those in an image
    # Errors of the density as shares of it: of its level, near 0, and what grows with the square of the width of a bump
    # to the widest, which is the median of chance.
    level: float
    even: float
    widest: float
    few: float  # The prior of the number of partners is in proportion to this power of it

    def background(self, apart: Array) -> Array:
        """Return the probability (classes,) of each class of distances of different objects, of these numbers.

        It is even near 0, as far as it takes for enough distances.
        """
        widths = np.diff(BORDERS**self.dimensions)
        near = np.cumsum(apart) <= max(EVEN_COUNT, EVEN_SHARE * apart.sum())
        smooth = np.where(near, apart[near].sum() * widths / max(float(widths[near].sum()), 1e-300), apart)
        return np.asarray((smooth + widths / widths.sum()) / (smooth.sum() + 1.0))

    def partners(self, spreads: Array) -> Array:
        """Return the probability (s, classes) of each class of distances of these standard deviations (s,), px."""
        from scipy.special import gammainc  # costly to import

        below = gammainc(0.5 * self.dimensions, 0.5 * (BORDERS / spreads[:, None]) ** 2)
        return np.asarray(np.maximum(np.diff(below, axis=1), 1e-300))


@dataclass(frozen=True)
class Mixture:
    """What distances tell."""

    likelihoods: Array  # (noises,): Logarithm, of the standard deviation of partners; the largest is 0
    gain: float  # Log-likelihood of the best of them over that without partners
    clear: float  # Share of partners among the distances as small as theirs


def classes(distances: Array) -> Array:
    """Return the numbers (classes,) of distances between the borders; their sign, if they have one, does not count."""
    return np.histogram(np.abs(distances[np.isfinite(distances)]), BORDERS)[0].astype(np.float64)


def unmix(kind: DistanceKind, together: Array, foreign: Sequence[Array], known: float, count: int) -> Mixture:
    """Return what the numbers of distances `together` (classes,) tell.

    `foreign` are probabilities (classes,) of distances of different objects, `known` from so many: any of them may be
    right, the first is that of chance. `count` is the number of detections, which have at most one partner each.
    """
    kept = max(int(np.searchsorted(np.cumsum(foreign[0]), 0.5)), 1)
    widths = 0.5 ** np.arange(BUMPS)
    bumps = np.exp(-0.5 * (BORDERS[1 : kept + 1] / (BORDERS[kept] * widths[:, None])) ** 2)
    errors = np.vstack([np.full(kept, kind.level), (kind.even + kind.widest * widths**2)[:, None] * bumps])
    total = max(float(together.sum()), 1.0)
    most = MOST_PARTNERS * min(max(count, 1), total)
    # chance is counted too: its error is that of so many distances
    weight = 1.0 / (1.0 + total / max(known, 1.0))
    # the last noise is without end: of no partner
    own = kind.partners(np.append(NOISES, 1e12))[:, :kept]
    fits = [_fit(together[:kept], density[:kept], errors, own, most, total, weight) for density in foreign]
    marginal, best, partners = (np.stack(each) for each in zip(*fits, strict=True))
    marginal += kind.few * np.log(partners / most)
    which, noise = divmod(int(best[:, :-1].argmax()), len(NOISES))
    likelihoods = np.logaddexp.reduce(np.logaddexp(marginal, np.log(STRANGERS) + best[:, -1:]), axis=0)[:-1]
    number, found = float(partners[which, noise]), own[noise]
    clear = number * found / (number * found + (total - number) * foreign[which][:kept])
    told = np.logaddexp(likelihoods - likelihoods.max(), -MOST_EVIDENCE)
    gain = float(best[which, noise] - best[:, -1].max())
    return Mixture(told, gain, float((found * clear).sum() / found.sum()))


def _fit(
    together: Array, foreign: Array, errors: Array, own: Array, most: float, total: float, weight: float
) -> tuple[Array, Array, Array]:
    """Return the log-likelihoods (s,) of noises over all numbers of partners, those of the best, and these numbers.

    Distances have the densities `own` (s, classes) or `foreign` (classes,), the latter times the exponential of a sum
    of `errors` (e, classes), each times a standard normal number. Newton's method for these and the partners.
    """
    from scipy.special import log_ndtr  # costly to import

    partners, sizes = np.full(len(own), 0.3 * most), np.zeros((len(own), len(errors)))
    for left in reversed(range(ROUNDS)):
        density = foreign * np.exp(sizes @ errors)
        others = (total - partners[:, None]) * density
        expected = others + partners[:, None] * own
        excess, change = together / expected - 1.0, own - density
        slopes = weight * (others * excess) @ errors.T - sizes
        info = weight * (errors * (others**2 / expected)[:, None]) @ errors.T + np.eye(len(errors))
        cross = weight * (others * change / expected) @ errors.T
        step, moved = np.moveaxis(np.linalg.solve(info, np.stack([slopes, cross], axis=2)), 2, 0)
        slope = weight * (change * excess).sum(axis=1) - (moved * slopes).sum(axis=1)
        curvature = weight * (change**2 / expected).sum(axis=1) - (moved * cross).sum(axis=1)
        root = np.sqrt(np.maximum(curvature, 1e-3 / most**2))
        if left:
            least, greatest = partners / MOST_CHANGE[1], np.minimum(most, partners * MOST_CHANGE[1])
            new = np.clip(partners + slope / root**2, least, greatest)
            sizes = sizes + np.clip(step - moved * (new - partners)[:, None], -MOST_CHANGE[0], MOST_CHANGE[0])
            partners = new
    best = weight * (together * np.log(expected) - expected).sum(axis=1) - 0.5 * (sizes**2).sum(axis=1)
    best = best - 0.5 * np.linalg.slogdet(info)[1]
    # the normal density of partners between 0 and the most
    centre = partners + slope / root**2
    low, high = -centre * root, (most - centre) * root
    low, high = np.where(low > 0.0, -high, low), np.where(low > 0.0, -low, high)
    inside = log_ndtr(high) + np.log1p(-np.exp(np.minimum(log_ndtr(low) - log_ndtr(high), -1e-12)))
    mass = inside + 0.5 * (slope / root) ** 2 + 0.5 * np.log(2.0 * np.pi) - np.log(root * most)
    return best + mass, best, partners
