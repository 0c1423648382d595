"""Do tracks and truth belong together? The default cutoff, and warnings where they come from different scenes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.errors import InputError
from stereophd.io.outputs.provenance import origin
from stereophd.pipeline.evaluation.inputs import Tracks
from stereophd.wording import LOGGER

# The paper's cutoff: 20 cm, or 20 standard deviations.
PAPER_CUTOFF, PAPER_UNIT = 20.0, "cm"
# Share of the scans, and of the truth's period, that the two must have in common.
LEAST_IN_COMMON = 0.5

# Largest share of matches beside another object without a warning: newborn tracks have large errors.
MOST_BESIDE = 0.01


def default_cutoff(base: str, unit: str | None, record: Mapping[str, Any] | None, tracks_path: Path) -> float:
    """Return the default cutoff from the base distance and the tracks' provenance; InputError if none gives a scale."""
    if base != "euclidean":
        return PAPER_CUTOFF
    stated = (((record or {}).get("config") or {}).get("evaluation") or {}).get("cutoff")
    if isinstance(stated, int | float):
        return float(stated)
    if unit == PAPER_UNIT:
        return PAPER_CUTOFF
    lengths = "no unit of length" if unit is None else f"lengths in {unit}"
    raise InputError(
        f"{tracks_path}: expected `cutoff`, or evaluation.cutoff in the configuration of the tracks and in this unit, "
        f"found neither, and {lengths}; choose the largest position error at which an object still counts as found"
    )


def warn_of_another_scene(inputs: Mapping[str, Path], tracks: Tracks, truth: Truth, scans: Mapping[str, int]) -> None:
    """Warn where provenance or times show that tracks and truth belong to different scenes."""
    of_log = ((tracks.metadata or {}).get("origins") or {}).get("detections")
    of_truth = origin(inputs["truth"])
    # logs of other commands, such as `import`, carry their own provenance
    made = [one.get("command") for one in (of_log, of_truth) if isinstance(one, dict)]
    if made == ["simulate", "simulate"] and of_log != of_truth:
        LOGGER.warning(
            "%s: another scene: these tracks were made from a log of another run than %s (by the provenance of both)",
            inputs["tracks"], inputs["truth"],
        )  # fmt: skip
        return
    time_s = tracks.events.time_s
    if not len(time_s):
        return
    start, end = float(truth.time_s.min()), float(truth.time_s.max())
    common = min(end, float(time_s.max())) - max(start, float(time_s.min()))
    outside = scans["outside_truth"]
    if outside > LEAST_IN_COMMON * (outside + scans["scored"]) and common < LEAST_IN_COMMON * (end - start):
        LOGGER.warning(
            "%s: %d of %d scans lie outside the times of %s (%g to %g s): do both belong to the same recording?",
            inputs["tracks"], outside, outside + scans["scored"], inputs["truth"], start, end,
        )  # fmt: skip


def warn_of_wrong_matches(tracks_path: Path, beside: int, matched: int, distance: float) -> None:
    """Warn where matches were kept although their tracks follow other objects: `beside` of the `matched` ones.

    Tracks and objects nearer than the distance may be matched.
    """
    if beside > MOST_BESIDE * matched:
        LOGGER.warning(
            "%s: in %d of %d matches the track follows another object, which is more than four times nearer. A match "
            "is kept while its distance is below %g. RMSE, NEES and figures of identity count these matches: state "
            "`match_distance` below the distance between objects",
            tracks_path, beside, matched, distance,
        )  # fmt: skip
