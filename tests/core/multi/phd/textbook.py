"""The Gaussian-mixture PHD filter of Vo and Ma (2006) in plain NumPy, for linear Gaussian models.

With births driven by the observations: every detection z may be a new object, with the mean (z, rest) and a
given covariance, and an expected number of births per frame that is uniform over the image. Independent of
the package: only NumPy. A mixture is a list of (weight, mean, covariance).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

Component = tuple[float, np.ndarray, np.ndarray]


@dataclass
class TextbookPhd:
    """B.-N. Vo and W.-K. Ma, "The Gaussian mixture probability hypothesis density filter", 2006."""

    transition: np.ndarray  # F of one step
    process: np.ndarray  # Q of one step
    noise: np.ndarray  # R (2, 2)
    survival: float  # of one step
    p_detect: float
    clutter: float  # false detections per frame
    births: float  # new objects per frame
    area: float  # of the image, px^2
    birth_mean: np.ndarray  # the state after (u, v)
    birth_covariance: np.ndarray
    prune: float
    merge: float
    cap: int
    mixture: list[Component] = field(default_factory=list)

    def step(self, detections: np.ndarray) -> float:
        """Predict and update with the detections (m, 2) of a frame; return their log-likelihood."""
        f, q = self.transition, self.process
        predicted = [(self.survival * w, f @ m, f @ p @ f.T + q) for w, m, p in self.mixture]
        h = np.eye(2, len(self.birth_mean) + 2)
        false, born = self.clutter / self.area, self.p_detect * self.births / self.area
        updated = [((1.0 - self.p_detect) * w, m, p) for w, m, p in predicted]
        log_likelihood = -self.clutter - self.p_detect * (self.births + sum(w for w, _, _ in predicted))
        for z in detections:
            parts = []
            for w, m, p in predicted:
                s = h @ p @ h.T + self.noise
                residual = z - h @ m
                density = np.exp(-0.5 * residual @ np.linalg.solve(s, residual))
                density /= 2.0 * np.pi * np.sqrt(np.linalg.det(s))
                gain = p @ h.T @ np.linalg.inv(s)
                parts.append((self.p_detect * w * density, m + gain @ residual, p - gain @ h @ p))
            parts.append((born, np.concatenate([z, self.birth_mean]), self.birth_covariance))
            total = false + sum(w for w, _, _ in parts)
            log_likelihood += np.log(total)
            updated += [(w / total, m, p) for w, m, p in parts]
        self.mixture = reduce(updated, self.prune, self.merge, self.cap)
        return float(log_likelihood)


def reduce(mixture: list[Component], prune: float, merge: float, cap: int) -> list[Component]:
    """Prune, merge what is near in the covariances of both, and cap."""
    left = [c for c in mixture if c[0] >= prune]
    merged = []
    while left:
        _, center, wide = max(left, key=lambda c: c[0])
        near, rest = [], []
        for w, m, p in left:
            d = m - center
            distance = max(d @ np.linalg.solve(p, d), d @ np.linalg.solve(wide, d))
            (near if distance <= merge else rest).append((w, m, p))
        total = sum(w for w, _, _ in near)
        mean = sum(w * m for w, m, _ in near) / total
        covariance = sum(w * (p + np.outer(m - mean, m - mean)) for w, m, p in near) / total
        merged.append((total, mean, covariance))
        left = rest
    if len(merged) > cap:
        # births of lone detections weigh the same: of those, the first are kept
        kept = sorted(range(len(merged)), key=lambda k: (-merged[k][0], k))[:cap]
        merged = [merged[k] for k in sorted(kept)]
    return merged
