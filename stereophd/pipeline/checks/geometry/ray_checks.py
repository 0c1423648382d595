"""Findings about cameras and clocks: do rays meet, and if not, which of the usual mistakes explains it?"""

from collections.abc import Iterator

from stereophd.pipeline.checks.finding import CHECK_CAMERAS, DO_NOT_MEET, Finding, Status
from stereophd.pipeline.checks.geometry.rays import LEAST_SCORE, MOST_CHANCE, TOLERANCES, Geometry, pairs_of
from stereophd.pipeline.checks.geometry.trials import MOST_CLOCKS, Explanation, best_explanation, usable_clocks
from stereophd.wording import percent

# Below this score rays meet by chance, and the share of what the settings promise that right cameras reach.
CHANCE_SCORE, LEAST_SHARE = 2.5, 0.4
# Standard deviations that the promise must be away from chance for a test, and by which it must be missed: the quantile
# of 0.5 % of Student's distribution with as many degrees of freedom as the times that measure chance leave.
POWER, LARGEST_DEFICIT = 6.0, 3.5
# Probability, by rays alone, that all objects are where a right camera does not see them, above which nothing follows:
# cameras are set up to see the same, so that it is less in truth.
UNSEEN = 0.25


def check_geometry(geometry: Geometry, is_blurred: bool = False) -> Iterator[Finding]:
    """Yield a finding for every pair of cameras, and what explains failures.

    Where rays meet and are blurred, what makes them meet better at one standard deviation is looked for.
    """
    yield from left_out(geometry)
    is_asked = geometry.pairs and (geometry.is_suspicious or is_blurred)
    if (explanation := best_explanation(geometry) if is_asked else None) is not None:
        yield _named(geometry, explanation)
    alone = set() if explanation is not None else _alone(geometry)
    for k, (pair, found) in enumerate(zip(geometry.pairs, geometry.given, strict=True)):
        names = f"{geometry.samples[pair.a].camera.name} and {geometry.samples[pair.b].camera.name}"
        text = (
            f"{names}: {percent(found.share)} of the detections have a partner on the epipolar line, chance gives "
            f"{percent(found.chance)}"
        )
        status: Status = "ok"
        remedy = cause = None
        if explanation is not None and {pair.a, pair.b} & set(explanation.trial.scope):
            status, text = "not checked", f"{text}; a cause is named"
        elif found.score < LEAST_SCORE and isinstance(why := _deficit(geometry, k), str):
            status, text = "not checked", f"{text}; {why}: not judged"
        elif found.score < CHANCE_SCORE and {pair.a, pair.b} & alone:
            status, text = "warning", f"{text}: the rays meet no more often than chance"
            remedy, cause = CHECK_CAMERAS, DO_NOT_MEET
        value, expected = round(found.excess, 3), round(geometry.expected[k], 3)
        yield Finding("geometry.rays", status, text, value, expected, None, remedy, cause)


def _deficit(geometry: Geometry, k: int) -> float | str:
    """Return by how many standard deviations pair k meets less often than it must, or why that cannot be decided.

    It must meet by `LEAST_SHARE` of what the settings promise: the objects may be elsewhere than the settings expect.
    Rays of right cameras meet at the tightest tolerance, at which chance gives least.
    """
    found = geometry.given_at(k, TOLERANCES[0])
    promised = LEAST_SHARE * geometry.expected[k] * (1.0 - found.chance)
    sample = geometry.samples[geometry.pairs[k].a]
    objects = max(sample.detections_per_frame - sample.camera.detector.clutter_per_frame, 1.0)
    if (1.0 - geometry.expected[k]) ** objects > UNSEEN:
        return "right cameras, too, may show hardly more than chance, as these objects may be where only one looks"
    spread = (found.share - found.chance) / found.score if found.score else 1.0
    if found.chance > MOST_CHANCE:
        return "most have one by chance"
    if promised < POWER * spread:
        return f"chance varies by {percent(spread)}, too much to tell wrong cameras"
    return promised / spread - found.score


def _alone(geometry: Geometry) -> set[int]:
    """Return the cameras whose rays meet those of no other camera, beyond chance at a false-alarm rate of 0.5 %.

    A camera whose rays meet those of one other is right, and the others see other objects. The deficits of all pairs of
    a camera are joined (S. A. Stouffer et al., "The American Soldier", 1949).
    """
    alone = set()
    for camera in range(len(geometry.samples)):
        own = [k for k, pair in enumerate(geometry.pairs) if camera in (pair.a, pair.b)]
        deficits = [deficit for k in own if not isinstance(deficit := _deficit(geometry, k), str)]
        met = any(geometry.given[k].score >= CHANCE_SCORE for k in own)
        if deficits and not met and sum(deficits) / len(deficits) ** 0.5 > LARGEST_DEFICIT:
            alone.add(camera)
    return alone


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
    trial, met, given = found.trial, found.met, found.given
    names = [geometry.samples[c].camera.name for c in trial.scope]
    everybody = len(names) == len(geometry.samples)
    who = "all cameras" if everybody else " and ".join(names)
    message = (
        f"{who}: {trial.text}: with this change {percent(met.share)} of the detections meet those of other cameras, "
        f"as stated {percent(given.share)}, by chance {percent(met.chance)}"
    )
    return Finding(
        "geometry.cause", "warning", message, round(given.excess, 3), round(met.excess, 3),
        None if everybody or len(names) != 1 else names[0], trial.remedy, trial.cause, trial.change,
    )  # fmt: skip
