"""Resampling schemes: every particle as often as its weight says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereophd.core.numerics.resampling import SCHEMES

WEIGHTS = np.array([0.05, 0.0, 0.4, 0.15, 0.3, 0.1, 0.0])


def counts(scheme: str, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    index = SCHEMES[scheme](weights, rng.random(len(weights) + 1))
    return np.bincount(index, minlength=len(weights))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_unbiased(scheme: str) -> None:
    rng = np.random.default_rng(1)
    draws = np.array([counts(scheme, WEIGHTS, rng) for _ in range(4000)])
    error = draws.mean(axis=0) - len(WEIGHTS) * WEIGHTS
    assert (np.abs(error) <= 5.0 * np.maximum(draws.std(axis=0), 1e-12) / np.sqrt(len(draws))).all()


def test_spread_of_the_schemes() -> None:
    """Independent draws spread most (n w (1 - w)); a comb of systematic teeth leaves floor or ceiling."""
    rng = np.random.default_rng(2)
    spread = {s: np.array([counts(s, WEIGHTS, rng) for _ in range(4000)]).var(axis=0).sum() for s in SCHEMES}
    assert spread["multinomial"] == pytest.approx((7 * WEIGHTS * (1 - WEIGHTS)).sum(), rel=0.1)
    assert max(spread["systematic"], spread["stratified"], spread["residual"]) < 0.6 * spread["multinomial"]


@given(
    weights=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40).filter(lambda w: sum(w) > 1e-3),
    seed=st.integers(0, 2**31),
)
def test_counts(weights: list[float], seed: int) -> None:
    normalised = np.array(weights) / np.sum(weights)
    expected = len(weights) * normalised
    for scheme in SCHEMES:
        found = counts(scheme, normalised, np.random.default_rng(seed))
        assert found.sum() == len(weights)
        assert (found[normalised == 0.0] == 0).all()
        if scheme == "residual":
            assert (found >= np.floor(expected - 1e-9)).all()
        if scheme == "systematic":
            assert (np.abs(found - expected) < 1.0 + 1e-9).all()
