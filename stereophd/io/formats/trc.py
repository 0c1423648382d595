"""TRC, the track row column files of OpenSim and others: markers at a fixed rate, as text.

A marker is a track, named ``track_N``. Positions keep the native world axes (x right, y down, z forward) and unit of
length, which the header names. Where a track does not exist its columns are empty.
"""

from pathlib import Path

import numpy as np

from stereophd.io.interchange.base import ExportOptions, Format
from stereophd.io.interchange.tracks import length_unit, on_grid


def write_tracks(tracks: Path, target: Path, options: ExportOptions) -> list[str]:
    """Write all tracks at a fixed rate."""
    rate, times, positions = on_grid(tracks, options)
    unit = length_unit(tracks)
    count, frames = len(positions), len(times)
    names = [f"track_{track}" for track in positions]
    head = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame"]
    values = [repr(rate), repr(rate), str(frames), str(count), unit, repr(rate), "1"]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{target.name if not target.name.startswith('.') else 'tracks.trc'}",
        "\t".join([*head, "OrigNumFrames"]),
        "\t".join([*values, str(frames)]),
        "\t".join(["Frame#", "Time", *(f"{name}\t\t" for name in names)]),
        "\t".join(["", "", *(f"X{k}\tY{k}\tZ{k}" for k in range(1, count + 1))]),
        "",
    ]
    stacked = np.stack(list(positions.values()), axis=1)
    with open(target, "w", encoding="utf-8", newline="\n") as stream:
        stream.write("\n".join(lines) + "\n")
        for frame, (time, row) in enumerate(zip(times.tolist(), stacked.reshape(frames, -1).tolist(), strict=True)):
            words = ["" if value != value else repr(value) for value in row]
            stream.write("\t".join([str(frame + 1), repr(time), *words]) + "\n")
    return []


FORMAT = Format("TRC: tracks as markers at a fixed rate", write_tracks=write_tracks)
