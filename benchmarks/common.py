"""What the benchmarks share: one thread, and a log's events in memory. Import it before NumPy."""

from __future__ import annotations

import os

# One thread, whatever NumPy was built with.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ[_name] = "1"

from pathlib import Path  # noqa: E402

from stereophd.config.loading import LoadedConfig  # noqa: E402
from stereophd.core.disparity.events import Event, make_event  # noqa: E402
from stereophd.io.logs import LogReader  # noqa: E402

PAPER_CONFIG = Path(__file__).resolve().parent.parent / "configs" / "paper" / "multi_object.yaml"


def read_events(loaded: LoadedConfig, log: Path, most: int | None = None) -> list[Event]:
    """Return the events of a log, undistorted; at most so many."""
    cameras = loaded.build_cameras()
    events: list[Event] = []
    for frame in LogReader(log, cameras, loaded.config.input.on_bad_row, loaded.config.input.image_margin_px):
        camera = cameras[frame.camera].at(frame.time_s)
        events.append(make_event(camera, frame.camera, frame.time_s, frame.pixels, frame.sigma))
        if len(events) == most:
            break
    return events
