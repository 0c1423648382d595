"""Findings about cameras and clocks: do rays meet, and if not, which of the usual mistakes explains it?"""

from __future__ import annotations

from collections.abc import Iterator

from stereophd.pipeline.checks.finding import Finding
from stereophd.pipeline.checks.geometry.causes import MOST_CLOCKS, Explanation, best_explanation, usable_clocks
from stereophd.pipeline.checks.geometry.measure import LEAST_EXPECTED, MOST_CHANCE, SHARP, Geometry, pairs_of
from stereophd.wording import percent

# Below this score the rays meet by chance only; the cause may be any.
CHANCE_SCORE, CHANCE_SHARE = 2.5, 0.4


def check_geometry(geometry: Geometry, thorough: bool) -> Iterator[Finding]:
    """Yield a finding for every pair of cameras, and what explains the pairs that fail.

    Parameters
    ----------
    geometry : Geometry
    thorough : bool
        Whether clock offsets are tried even where nothing is suspicious.
    """
    yield from left_out(geometry)
    suspicious = [k for k in range(len(geometry.pairs)) if geometry.is_suspicious(k)]
    explanation = None
    if geometry.pairs and (suspicious or thorough):
        explanation = best_explanation(geometry, thorough, clocks_only=not suspicious)
    if explanation is None and geometry.is_blurred():
        explanation = best_explanation(geometry, thorough, tolerances=SHARP)
    if explanation is not None:
        yield _named(geometry, explanation)
    for pair, found, expected in zip(geometry.pairs, geometry.given, geometry.expected, strict=True):
        names = f"{geometry.samples[pair.a].camera.name} and {geometry.samples[pair.b].camera.name}"
        text = (
            f"{names}: {percent(found.share)} of the detections have a partner on the epipolar line, chance gives "
            f"{percent(found.chance)}"
        )
        if expected < LEAST_EXPECTED:
            yield Finding("geometry.rays", "not checked", f"{text}; their fields of view hardly overlap")
        elif found.chance > MOST_CHANCE:
            yield Finding("geometry.rays", "not checked", f"{text}; the objects hardly move, or are too many")
        elif (
            explanation is None
            and found.score < CHANCE_SCORE
            and found.share < found.chance + CHANCE_SHARE * expected * (1.0 - found.chance)
        ):
            yield Finding(
                "geometry.rays",
                "warning",
                f"{text}: the rays meet no more often than chance",
                round(found.excess, 3),
                round(expected, 3),
                remedy="check the poses, intrinsics and clocks of both cameras; calibrate can estimate the poses",
                cause="rays_do_not_meet",
            )
        else:
            yield Finding("geometry.rays", "ok", text, round(found.excess, 3), round(expected, 3))


def left_out(geometry: Geometry) -> Iterator[Finding]:
    """Yield a finding where so many cameras are checked that pairs of them, or usable clocks, are left out."""
    cameras = len(geometry.samples)
    possible, examined = cameras * (cameras - 1) // 2, len(pairs_of(cameras))
    usable = len(usable_clocks(geometry))
    clocks = max(usable - MOST_CLOCKS, 0)
    if possible == examined and clocks == 0:
        return
    parts = []
    if possible > examined:
        parts.append(f"the rays of {possible - examined} of {possible} pairs of cameras are not compared")
    if clocks:
        parts.append(
            f"where a clock offset or rate is looked for, {clocks} of {usable} usable clocks are not "
            "tried, those of the cameras whose rays meet most"
        )
    remedy = "to check the others, run `check` on a configuration and log of fewer cameras"
    yield Finding(
        "geometry.left_out", "not checked", "; ".join(parts), possible - examined, 0, None, remedy, "many_cameras"
    )


def _named(geometry: Geometry, found: Explanation) -> Finding:
    names = [geometry.samples[c].camera.name for c in found.cameras]
    everybody = len(names) == len(geometry.samples)
    who = "all cameras" if everybody else " and ".join(names)
    message = (
        f"{who}: {found.text}: with this change {percent(found.share)} of the detections meet those of other cameras, "
        f"as stated {percent(found.given_share)}, by chance {percent(found.chance)}"
    )
    return Finding(
        "geometry.cause",
        "warning",
        message,
        round(found.given, 3),
        round(found.excess, 3),
        None if everybody or len(names) != 1 else names[0],
        found.remedy,
        found.cause,
    )
