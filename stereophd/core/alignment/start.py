"""Which track follows a control track on a clock of its own, and roughly how the two lie to each other.

Of every track and every offset of the clocks the best similarity has a closed form (S. Umeyama, "Least-squares
estimation of transformation parameters between two point patterns", PAMI 1991), which needs no more than sums over the
common times, weighted by what is known of the places. These are correlations, found for all offsets at once by Fourier
transforms. With the part u of the variance of the control that a similarity leaves, over a common time of T seconds
(the cells times the number that weights w are worth, sum(w)^2 / sum(w^2)), the gain is T log(1 / u): a short piece that
fits by chance has a smaller gain than a long one that fits.
"""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.core.metrics.truth.registration import Freedom, Registration

# Cells of time: no finer than this part of both spans together, and no fewer common ones.
MOST_CELLS, LEAST_CELLS = 16_384, 12
# Least part of the shorter of the two that is common: short pieces fit by chance.
LEAST_COMMON = 0.5
# Common weight, in parts of the largest, below which it is rounding.
LEAST_WEIGHT = 1e-9
# Least part of the variance that is left: rounding of the transforms.
LEAST_UNEXPLAINED = 1e-10
# Another offset or curve fits nearly as well with more than this part of the gain, and less than this many times the
# variance left. Other offsets lie beyond worse ones, or further than these seconds and this part of the common time.
OTHER_GAIN, OTHER_UNEXPLAINED = 0.5, 4.0
OTHER_OFFSET_S, OTHER_SHARE = 2.0, 0.1


@dataclass(frozen=True)
class Curve:
    """Positions of one object over time."""

    time_s: Array  # (n,), increasing
    position: Array  # (n, 3)
    weight: Array  # (n,): Of each place, by what is known of it

    def on_grid(self, start: float, step: float, count: int, max_gap_s: float) -> tuple[Array, Array]:
        """Positions (count, 3) at equal steps of time, interpolated linearly, and their weights; 0 where not known."""
        grid = start + step * np.arange(count)
        table = np.column_stack([self.position, self.weight])
        values = np.column_stack([np.interp(grid, self.time_s, column) for column in table.T])
        right = np.searchsorted(self.time_s, grid).clip(1, len(self.time_s) - 1)
        near = self.time_s[right] - self.time_s[right - 1] <= max(max_gap_s, 2.0 * step)
        known = near & (grid >= self.time_s[0]) & (grid <= self.time_s[-1])
        return values[:, :3], values[:, 3] * known


@dataclass(frozen=True)
class CurveFit:
    """How well a curve fits the control at every offset of the clocks."""

    curve: int  # Its number
    offsets: Array  # (k,): What the control's clock shows more, s
    gains: Array  # (k,): T log(1 / u), s
    unexplained_at: Array  # (k,): The part u of the variance
    best: int  # The offset of the greatest gain
    common_s: float  # Common time at that offset, s
    registration: Registration  # At that offset

    @property
    def gain(self) -> float:
        """The greatest gain, s."""
        return float(self.gains[self.best])

    @property
    def unexplained(self) -> float:
        """Part of the control's variance that is left at the best offset."""
        return float(self.unexplained_at[self.best])

    @property
    def rival(self) -> float | None:
        """Another offset that fits nearly as well, s; None if there is none.

        Offsets next to the best one belong to it, as far as the gain falls steadily or the motion allows no better.
        """
        elsewhere = np.abs(self.offsets - self.offsets[self.best]) > max(OTHER_OFFSET_S, OTHER_SHARE * self.common_s)
        alike = self.gains > OTHER_GAIN * self.gain
        alike &= self.unexplained_at < OTHER_UNEXPLAINED * self.unexplained_at[self.best]
        dips = np.flatnonzero(~alike)
        number = np.arange(len(alike))
        elsewhere |= number < dips[dips < self.best].max(initial=-1)
        elsewhere |= number > dips[dips > self.best].min(initial=len(alike))
        places = np.flatnonzero(elsewhere & alike)
        return float(self.offsets[places[self.gains[places].argmax()]]) if len(places) else None


def fits_to(curves: list[Curve], control: Truth, max_gap_s: float, freedom: Freedom) -> list[CurveFit]:
    """Fit curves to a control track at every offset of the clocks; those without enough common times are left out.

    Where the clock is not free, the only offset is 0.
    """
    target = Curve(control.time_s, control.position, np.ones(len(control.time_s)))
    out = []
    for number, curve in enumerate(curves):
        spans = [float(np.ptp(one.time_s)) for one in (curve, target)]
        step = max(control.step_s, sum(spans) / MOST_CELLS)
        counts = [int(span / step) + 1 for span in spans]
        # a clock that is known: cells of both at the same times
        starts = [float(one.time_s[0]) for one in (curve, target)]
        starts[1] = starts[1] if freedom.clock else starts[0] + step * np.round((starts[1] - starts[0]) / step)
        a, b = (
            one.on_grid(start, step, count, max_gap_s)
            for one, start, count in zip((curve, target), starts, counts, strict=True)
        )
        offsets: Array = starts[1] - starts[0] + step * np.arange(1 - counts[0], counts[1], dtype=np.float64)
        used = np.ones(len(offsets), dtype=bool) if freedom.clock else np.abs(offsets) < 0.5 * step
        fit = _fit(number, a, b, offsets, used, step, freedom.scale)
        if fit is not None:
            out.append(fit)
    return out


def turns_between(products: Array) -> tuple[Array, Array, Array]:
    """Return the rotations L R nearest to sums of products b a^T (n, 3, 3) as L and R, and how well they agree (n,).

    With the sum of squares of a, the agreement over it is the scale of the best similarity from a to b.
    """
    left, sizes, right = np.linalg.svd(products)
    signs = np.ones((len(sizes), 3))
    signs[:, 2] = np.sign(np.linalg.det(left @ right))
    return left * signs[:, None], right, (signs * sizes).sum(axis=1)


def _fit(
    number: int,
    a: tuple[Array, Array],
    b: tuple[Array, Array],
    offsets: Array,
    used: Booleans,
    step: float,
    any_scale: bool,
) -> CurveFit | None:
    """Fit positions (p, 3) to (q, 3), each with weights, at all p + q - 1 offsets; None if no offset will do.

    The weights of the second are 0 or 1.
    """
    if not (a[1].any() and b[1].any()):
        return None
    middles = [np.average(values, axis=0, weights=weights) for values, weights in (a, b)]
    length = len(a[0]) + len(b[0]) - 1
    spectra = []
    for (values, weights), middle in zip((a, b), middles, strict=True):
        moved = values - middle
        features = np.column_stack([np.ones(len(moved)), moved, (moved**2).sum(axis=1), weights]) * weights[:, None]
        spectra.append(np.fft.rfft(features, length, axis=0))
    # sums over the common times of products of both features, with the offsets in increasing order
    sums = np.fft.irfft(np.conj(spectra[0])[:, :, None] * spectra[1][:, None, :], length, axis=0)
    sums = np.roll(sums, len(a[0]) - 1, axis=0)
    total, least = sums[:, 0, 0], LEAST_WEIGHT * sums[:, 0, 0].max()
    safe = np.maximum(total, least)
    count = np.where(total > least, total**2 / np.maximum(sums[:, 5, 0], least**2), 0.0)
    cross = sums[:, 1:4, 1:4] - sums[:, 1:4, 0, None] * sums[:, 0, None, 1:4] / safe[:, None, None]
    spread_a = sums[:, 4, 0] - (sums[:, 1:4, 0] ** 2).sum(axis=1) / safe
    spread_b = sums[:, 0, 4] - (sums[:, 0, 1:4] ** 2).sum(axis=1) / safe
    shorter = min(float(weights.sum() ** 2 / (weights**2).sum()) for _, weights in (a, b))
    used = used & (count >= max(LEAST_CELLS, LEAST_COMMON * shorter)) & (np.minimum(spread_a, spread_b) > 0.0)
    if not used.any():
        return None
    left, right, agreement = turns_between(np.swapaxes(cross[used], 1, 2))
    spread_a, spread_b = spread_a[used], spread_b[used]
    scales = agreement / spread_a if any_scale else np.ones(len(agreement))
    left_over = 1.0 + (scales**2 * spread_a - 2.0 * scales * agreement) / spread_b
    unexplained = np.maximum(left_over, LEAST_UNEXPLAINED)
    gains = -np.log(unexplained) * count[used] * step
    best = int(gains.argmax())
    rotation, scale = left[best] @ right[best], float(scales[best])
    if scale <= 0.0:
        return None
    place = np.flatnonzero(used)[best]
    mean_a, mean_b = (
        middle + moment / total[place]
        for middle, moment in zip(middles, (sums[place, 1:4, 0], sums[place, 0, 1:4]), strict=True)
    )
    shift = float(offsets[place])
    found = Registration(rotation, mean_b - scale * rotation @ mean_a, scale, 0.0, shift, 1.0, int(count[place]))
    return CurveFit(number, offsets[used], gains, unexplained, best, float(count[place] * step), found)
