"""How often the rays of each pair of cameras meet, and what the configuration promises."""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

from stereophd.core.arrays import Array
from stereophd.pipeline.checks.geometry.rays import (
    Candidates,
    Meeting,
    Reading,
    candidates,
    expected_excess,
    meeting,
    rays_of,
)
from stereophd.pipeline.checks.log.sample import CameraSample

# A pair below this share of what the configuration promises, or below this score, is suspicious.
SUSPICIOUS_SHARE, SUSPICIOUS_SCORE = 0.6, 4.0
# From this score on rays meet beyond doubt.
LEAST_SCORE = 6.0
# Above this share of partners by chance, shifted times show nothing.
MOST_CHANCE = 0.6
# Below this expected excess the fields of view of a pair hardly overlap, and the pair cannot be checked.
LEAST_EXPECTED = 0.15
# Pairs of cameras that are examined at most: all of 25 cameras.
MOST_PAIRS = 300


@dataclass(frozen=True)
class Geometry:
    """How often the rays of each pair of cameras meet."""

    samples: list[CameraSample]
    pairs: tuple[Candidates, ...]
    given: tuple[Meeting, ...]  # How well rays meet for every pair, with the cameras as stated
    expected: tuple[float, ...]  # Excess that the configuration promises, pair by pair

    @property
    def views(self) -> list[Reading]:
        """The cameras as stated."""
        return [Reading(sample.camera) for sample in self.samples]

    @cached_property
    def rays(self) -> list[tuple[Array, Array]]:
        """The rays of every pair, with the cameras as stated (see `rays_of`)."""
        views = self.views
        return [rays_of(pair, views[pair.a], views[pair.b]) for pair in self.pairs]

    def is_suspicious(self, k: int) -> bool:
        """Whether fewer rays of pair k meet than the configuration promises, or no more than by chance.

        Wrong poses may promise nothing, so a pair that meets by chance only is suspicious in any case.
        """
        found, expected = self.given[k], self.expected[k]
        if found.chance > MOST_CHANCE and found.share > MOST_CHANCE:
            return False
        return found.score < SUSPICIOUS_SCORE or (
            expected >= LEAST_EXPECTED and found.excess < SUSPICIOUS_SHARE * expected
        )


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Return the pairs of cameras that are examined: all, or of many cameras each with those next to it in their order.

    The time of the checks would grow with the square of the number of cameras.
    """
    if count * (count - 1) // 2 <= MOST_PAIRS:
        return list(combinations(range(count), 2))
    steps = range(1, max(1, MOST_PAIRS // count) + 1)
    return sorted({(min(a, b), max(a, b)) for step in steps for a in range(count) for b in [(a + step) % count]})


def measure(samples: list[CameraSample], depths: tuple[float, float], thorough: bool = True) -> Geometry:
    """Measure how often rays of every pair of cameras meet, with more detections if `thorough`.

    Objects are expected between the two depths, length.
    """
    pairs = []
    most = (400 if len(samples) < 4 else 200) if thorough else 120
    for a, b in pairs_of(len(samples)):
        found = candidates(samples, a, b, most)
        if found is not None:
            pairs.append(found)
    given = [meeting(pair, Reading(samples[pair.a].camera), Reading(samples[pair.b].camera)) for pair in pairs]
    expected = [expected_excess(pair, samples, depths) for pair in pairs]
    return Geometry(samples, tuple(pairs), tuple(given), tuple(expected))
