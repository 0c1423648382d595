"""TUM trajectories, as evo and others read them: ``timestamp tx ty tz qx qy qz qw``, one track.

Positions keep the native world axes and unit of length. Tracks have no orientation: the quaternion is the identity.
The format holds one trajectory; of several tracks one must be chosen.
"""

from pathlib import Path

from stereophd.errors import InputError
from stereophd.io.interchange.base import ExportOptions, Format
from stereophd.io.interchange.tracks import trajectories


def write_tracks(tracks: Path, target: Path, options: ExportOptions) -> list[str]:
    """Write the trajectory of one track."""
    found = trajectories(tracks, options)
    if len(found) != 1:
        listed = ", ".join(map(str, list(found)[:20]))
        raise InputError(
            f"{tracks}: expected one track for this format, found {len(found)}; choose one by `tracks`: {listed}"
        )
    ((times, states),) = found.values()
    with open(target, "w", encoding="utf-8", newline="\n") as stream:
        stream.write("# timestamp tx ty tz qx qy qz qw\n")
        for time, (x, y, z) in zip(times.tolist(), states[:, :3].tolist(), strict=True):
            stream.write(f"{time!r} {x!r} {y!r} {z!r} 0 0 0 1\n")
    return ["tracks have no orientation: the quaternion is the identity"]


FORMAT = Format("TUM: the trajectory of one track", write_tracks=write_tracks)
