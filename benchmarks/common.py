"""What the benchmarks share: one thread, and a log's events in memory. Import it before NumPy."""

from __future__ import annotations

import os

# One thread, whatever NumPy was built with.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ[_name] = "1"

from itertools import islice  # noqa: E402
from pathlib import Path  # noqa: E402

from stereophd.config.loading import LoadedConfig  # noqa: E402
from stereophd.core.disparity.events import Event  # noqa: E402
from stereophd.pipeline.stream import open_stream  # noqa: E402

PAPER_CONFIG = Path(__file__).resolve().parent.parent / "configs" / "paper" / "multi_object.yaml"


def read_events(loaded: LoadedConfig, log: Path, most: int | None = None) -> list[Event]:
    """Return the events of a log, undistorted; at most so many."""
    return list(islice(open_stream(loaded.config, loaded.build_cameras(), log), most))
