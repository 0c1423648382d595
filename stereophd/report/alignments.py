"""Reports of `align` as text for a terminal."""

from collections.abc import Mapping
from typing import Any

from stereophd.wording import number


def alignments_text(report: Mapping[str, Any]) -> str:
    """Return a paragraph for each run."""
    return "\n\n".join("\n".join(_lines(run)) for run in report["runs"])


def _lines(run: Mapping[str, Any]) -> list[str]:
    unit, clock = run["length_unit"], run["clock"]
    lines = [
        f"{run['name']} to {run['to']}",
        f"  scale        {run['scale']:.6g} +- {number(run['scale_std'])}",
        f"  rotation     {_vector(run['rotation_deg'])} +- {_vector(run['rotation_std_deg'])} deg",
        f"  translation  {_vector(run['translation'])} +- {_vector(run['translation_std'])} {unit}",
        f"  clock        {clock['shift_s']:+.4f} +- {number(clock['shift_std_s'])} s at {clock['at_s']:.3f} s, "
        f"rate {clock['rate']:.7g} +- {number(clock['rate_std'])}",
    ]
    for name, of in (("residual", unit), ("residual_px", "px")):
        if name in run:
            left = run[name]
            lines.append(f"  left over    {number(left['median'])} {of} (median), {number(left['p90'])} {of} (90 %)")
    if run["tracks"]:
        more = " and others" if len(run["tracks"]) > 8 else ""
        lines.append(f"  tracks       {', '.join(map(str, run['tracks'][:8]))}{more}")
    if "scale_is_unknown" in run:
        lines.append(f"  {run['scale_is_unknown']}")
    return lines


def _vector(values: list[float]) -> str:
    return "[" + ", ".join(number(value, 4) for value in values) + "]"
