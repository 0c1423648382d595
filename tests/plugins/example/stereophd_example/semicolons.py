"""Tracks as text: ``time;track;x;y;z``."""

from pathlib import Path

from stereophd.io.interchange.base import ExportOptions, Format
from stereophd.io.interchange.tracks import trajectories


def write_tracks(tracks: Path, target: Path, options: ExportOptions) -> list[str]:
    """Write the confirmed estimates."""
    with open(target, "w", encoding="utf-8") as stream:
        for track, (times, states) in trajectories(tracks, options).items():
            for time, (x, y, z) in zip(times.tolist(), states[:, :3].tolist(), strict=True):
                stream.write(f"{time};{track};{x};{y};{z}\n")
    return []


FORMAT = Format("text with semicolons", write_tracks=write_tracks)
