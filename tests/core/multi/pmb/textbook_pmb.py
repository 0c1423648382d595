"""A Poisson multi-Bernoulli filter in plain NumPy, Bernoulli by Bernoulli, for linear Gaussian models.

Williams (2015), the track-oriented marginal filter with one Gaussian a track, with association marginals by
enumeration (of each cluster of tracks and detections that have anything to do with one another), and births
driven by the observations as in `TextbookPhd`. Independent of the package.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tests.core.multi.phd.textbook import Component, reduce

# what the package documents that it leaves out: pairs beyond this distance
REACH = 9.0


def exact_marginals(odds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Marginals (pairs, missed, unclaimed) and log evidence, cluster by cluster."""
    from tests.core.multi.association.associations import enumerate_associations

    n_tracks, n_detections = odds.shape
    pair, missed, unclaimed, evidence = np.zeros_like(odds), np.ones(n_tracks), np.ones(n_detections), 0.0
    left = set(range(n_tracks))
    while left:
        rows, columns = {left.pop()}, set()
        while True:
            wider = set(np.flatnonzero(odds[sorted(rows)].any(axis=0)).tolist())
            more = set(np.flatnonzero(odds[:, sorted(wider)].any(axis=1)).tolist()) | rows
            if (more, wider) == (rows, columns):
                break
            rows, columns = more, wider
        left -= rows
        if not columns:
            continue
        block = np.ix_(sorted(rows), sorted(columns))
        exact = enumerate_associations(odds[block])
        pair[block], missed[sorted(rows)], unclaimed[sorted(columns)] = exact.pair, exact.missed, exact.unclaimed
        evidence += exact.log_evidence
    return pair, missed, unclaimed, evidence


def mixed(parts: list[Component]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a mixture."""
    total = sum(w for w, _, _ in parts)
    mean = sum(w * m for w, m, _ in parts) / total
    covariance = sum(w * (p + np.outer(m - mean, m - mean)) for w, m, p in parts) / total
    return np.asarray(mean), np.asarray(covariance)


@dataclass
class TextbookPmb:
    """Fields as `TextbookPhd`; `tracks` are Bernoullis (existence, mean, covariance)."""

    transition: np.ndarray
    process: np.ndarray
    noise: np.ndarray
    survival: float
    p_detect: float
    clutter: float
    births: float
    area: float
    birth_mean: np.ndarray
    birth_covariance: np.ndarray
    prune: float
    merge: float
    tracks: list[Component] = field(default_factory=list)

    def predict(self, mixture: list[Component]) -> list[Component]:
        f = self.transition
        return [(self.survival * w, f @ m, f @ p @ f.T + self.process) for w, m, p in mixture]

    def updated(self, z: np.ndarray, m: np.ndarray, p: np.ndarray) -> Component:
        """Likelihood of a detection, and the state given it; likelihood 0 out of reach."""
        h = np.eye(2, len(m))
        s = h @ p @ h.T + self.noise
        residual = z - h @ m
        squared = residual @ np.linalg.solve(s, residual)
        density = np.exp(-0.5 * squared) / (2.0 * np.pi * np.sqrt(np.linalg.det(s))) if squared <= REACH**2 else 0.0
        gain = p @ h.T @ np.linalg.inv(s)
        return float(density), m + gain @ residual, p - gain @ h @ p

    def step(self, detections: np.ndarray) -> float:
        """Predict and update with the detections (m, 2) of a frame; return their log-likelihood."""
        tracks = self.predict(self.tracks)
        pd, born = self.p_detect, self.p_detect * self.births / self.area
        old = [[self.updated(z, m, p) for z in detections] for _, m, p in tracks]
        other = self.clutter / self.area + born
        missed = np.array([1.0 - pd * r for r, _, _ in tracks])
        odds = np.array([[u[0] for u in row] for row in old]).reshape(len(tracks), len(detections))
        odds = odds * np.array([pd * r for r, _, _ in tracks])[:, None] / missed[:, None] / other
        pair, none, unclaimed, evidence = exact_marginals(odds)
        log_likelihood = evidence + len(detections) * np.log(other) + np.log(missed).sum()
        log_likelihood -= self.clutter + pd * self.births

        after: list[Component] = []
        for i, (r, m, p) in enumerate(tracks):
            still = none[i] * (1.0 - pd) * r / missed[i]
            existence = still + pair[i].sum()
            shares = [(pair[i, j], *old[i][j][1:]) for j in range(len(detections))]
            shares = [c for c in shares if c[0] > 0.0]
            after.append((min(existence, 1.0), *mixed([(still, m, p), *shares])))
        for j, z in enumerate(detections):
            after.append((unclaimed[j] * born / other, np.concatenate([z, self.birth_mean]), self.birth_covariance))
        strong = reduce([c for c in after if c[0] >= self.prune], 0.0, self.merge, 10**6)
        self.tracks = [(min(r, 1.0), m, p) for r, m, p in strong]
        return float(log_likelihood)
