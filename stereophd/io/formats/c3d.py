"""C3D, the binary motion-capture format: tracks as points at a fixed rate, written with ezc3d (extra ``c3d``).

A point is a track, named ``track_N``. Positions keep the native world axes and unit of length (``POINT:UNITS``). The
format holds single precision, and no time of the first frame: that goes into ``STEREOPHD:FIRST_TIME_S``.
"""

import tempfile
from pathlib import Path

import numpy as np

from stereophd.io.documents import need_package
from stereophd.io.interchange.base import ExportOptions, Format
from stereophd.io.interchange.tracks import length_unit, on_grid
from stereophd.io.outputs.disk import TEMPORARY_PREFIX


def write_tracks(tracks: Path, target: Path, options: ExportOptions) -> list[str]:
    """Write all tracks at a fixed rate."""
    ezc3d = need_package("ezc3d", "the format c3d")
    rate, times, positions = on_grid(tracks, options)
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["parameters"]["POINT"]["LABELS"]["value"] = [f"track_{track}" for track in positions]
    file["parameters"]["POINT"]["UNITS"]["value"] = [length_unit(tracks)]
    file.add_parameter("STEREOPHD", "FIRST_TIME_S", [float(times[0])])
    points = np.ones((4, len(positions), len(times)))
    points[:3] = np.stack(list(positions.values()), axis=0).transpose(2, 0, 1)
    file["data"]["points"] = points
    # ezc3d writes beside a name without its ending
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=TEMPORARY_PREFIX) as folder:
        written = Path(folder) / "tracks.c3d"
        file.write(str(written))
        written.replace(target)
    return ["positions have single precision"]


FORMAT = Format("C3D: tracks as points at a fixed rate", write_tracks=write_tracks)
