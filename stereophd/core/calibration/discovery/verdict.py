"""Whether cameras that were found are believed, and what kind of motion leaves them open.

A start counts by absolute deviations and by its lead over the next other optimum: a prior made from the data says
nothing about what the data determine. The limits parted right from wrong answers on recordings with known cameras.
"""

from collections.abc import Sequence

import numpy as np

from stereophd.core.calibration.discovery.pair_fit import PairFit
from stereophd.core.calibration.discovery.tracks import SlopeTracks
from stereophd.core.calibration.discovery.two_cameras import Link

# What is wrong with which cameras, and the remedy.
Doubt = tuple[str, str]

# Largest deviations of rotation and direction, rad, of a pair that others start from.
MOST_ROTATION, MOST_DIRECTION = np.deg2rad(6.0), np.deg2rad(10.0)
# Lead over the next optimum, at least: nats, which that of one in 200 pairs of cameras without a common object exceeds
# (e times fewer every 2.4); and a part of the gain, since residuals are not noise alone.
LEAST_LEAD, LEAST_PART = 10.0, 0.2
# Quadratic pieces that two cameras need in common: fewer can agree by chance; share of the points in front of both.
LEAST_PIECES, LEAST_FRONT = 4.0, 0.95
# Residuals of the best optimum over the stated noise above which a lens or clock is wrong.
MOST_RESIDUAL = 3.0
# Median parallax, rad, below which the cameras stand at one place; thickness over extent of a scene that is a plane.
LEAST_PARALLAX, PLANE = np.deg2rad(1.0), 0.02
MORE_OBJECTS = "record more objects that all see"


def doubts_of_tracks(found: SlopeTracks, names: Sequence[str]) -> str | None:
    """Return why no cameras can be found from the tracks; None if they can be looked for."""
    still = [name for number, name in enumerate(names) if not len(found.of_camera(number))]
    if not still:
        return None
    if found.left_out:
        return (
            f"nothing moves before {', '.join(still)} (by 12 standard deviations of a detection, seen in half of the "
            "frames): objects that stand still show no cameras; record objects that move through the whole image"
        )
    return (
        f"no object can be followed before {', '.join(still)}: state speeds and accelerations (motion, filter.birth) "
        "that fit the depths, or record fewer false detections, or more frames"
    )


def sentences(doubts: Sequence[Doubt]) -> tuple[str, ...]:
    """Say each doubt and each remedy once."""
    by_remedy: dict[str, dict[str, None]] = {}
    for what, remedy in doubts:
        by_remedy.setdefault(remedy, {})[what] = None
    return tuple(f"{', '.join(what)}: {remedy}" for remedy, what in by_remedy.items())


def lead_of(gain: float, other: float) -> float:
    """Return by how much a pose gains more than another one does, over what it needs to be believed."""
    return (gain - other) / max(LEAST_LEAD, LEAST_PART * gain)


def doubts_of_pair(pair: Link, names: Sequence[str]) -> list[Doubt]:
    """Return why two cameras that were found may be wrong; empty if they are believed.

    Where pairs close a loop, what each leaves open (focal lengths above all) may be determined by all: the final answer
    is judged, not the pair.
    """
    fit = pair.best
    two = " and ".join(names[number] for number in pair.cameras)
    # a remedy names what is stated: what is unknown has a deviation
    clock_is_stated, lens_is_stated = bool(fit.stds[5] == 0.0), bool((fit.stds[9:11] == 0.0).any())
    doubts: list[Doubt] = []
    if fit.parallax < LEAST_PARALLAX:
        remedy = "the cameras stand at one place, or the objects are too far; move them apart or the objects nearer"
        doubts.append((f"rays of {two} meet at {np.rad2deg(fit.parallax):.1f} degrees", remedy))
    if fit.pieces < LEAST_PIECES:
        few = f"the tracks that {two} share are too few or too straight ({fit.pieces:.1f} pieces of a curve)"
        doubts.append((few, f"{LEAST_PIECES:g} pieces are needed, record objects that turn, or more of them"))
    if not doubts and fit.front < LEAST_FRONT:
        few = f"the tracks of {two} agree by chance ({100.0 * fit.front:.0f} % of the points lie in front of both)"
        remedy = "record the same moving objects with both, at one time"
        doubts.append((few, remedy + ("" if lens_is_stated else ", and state the lenses")))
    if doubts:
        return doubts  # what follows from them says no more
    if fit.residual > MOST_RESIDUAL:
        stated = " or ".join(["a focal length", *["a lens"] * lens_is_stated, *["a clock"] * clock_is_stated])
        remedy = f"{stated} may be wrong; state rough poses, or record more objects"
        doubts.append((f"rays of {two} miss each other by {fit.residual:.1f} times the noise", remedy))
    if lead_of(*pair.gains) < 1.0:
        doubts.append(_second_optimum(pair, two, clock_is_stated))
    if pair.agreeing <= pair.opposed:
        doubts.append((f"the pose of {two} contradicts other pairs of cameras ({pair.opposed})", MORE_OBJECTS))
    if pair.agreeing == 1 and (fit.rotation_std > MOST_ROTATION or fit.direction_std > MOST_DIRECTION):
        kind = "; the objects move in one plane" if _is_plane(fit) else ""
        rotation, direction = np.rad2deg([fit.rotation_std, fit.direction_std])
        left = f"the tracks leave {two} open by {rotation:.1f} degrees in rotation and {direction:.1f} in direction"
        doubts.append((f"{left}{kind}", "record objects at more depths and heights"))
    return doubts


def _second_optimum(pair: Link, two: str, clock_is_stated: bool) -> Doubt:
    """Return how the second-best pose of a camera differs from the best, and the remedy."""
    (turn, later), (gain, other) = pair.other, pair.gains
    away, remedy = f"turned by {np.rad2deg(turn):.0f} degrees", "record objects that speed up and turn"
    if not clock_is_stated:
        away, remedy = f"{away}, {later:+.2f} s away", f"{remedy}, or state the clock"
    return f"another pose of {two} explains {100.0 * other / max(gain, 1e-9):.0f} % as much, {away}", remedy


def _is_plane(fit: PairFit) -> bool:
    """Whether the points lie in one plane."""
    if len(fit.points) < 4:
        return True
    sizes = np.linalg.svd(fit.points - fit.points.mean(axis=0), compute_uv=False)
    return bool(sizes[2] < PLANE * sizes[0])
