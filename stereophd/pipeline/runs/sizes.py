"""How much memory and disk space a run is going to need, estimated before it begins.

A run that does not fit is refused. One that fills much of a disk may be wanted, but more often a number in the
configuration is wrong: it begins only if the user confirms it. How long a run takes is shown by its progress.
"""

import contextlib
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from stereophd.config.loading import LoadedConfig
from stereophd.core.simulation.timing import INSTANTS_PER_WINDOW
from stereophd.errors import InputError, SizeError

# Beyond this a run must be confirmed.
LARGEST_DISK_BYTES = 50e9

# Measured with `simulate`: bytes of a detection, an object at a time of the truth and a run in the files; bytes in
# memory of an object in a frame, a detection, a drawn object and a run.
_DETECTION_FILE, _TRUTH_FILE, _RUN_FILE = 16.0, 40.0, 100.0
_STATE_MEMORY, _DETECTION_MEMORY, _OBJECT_MEMORY, _RUN_MEMORY = 200.0, 150.0, 3000.0, 2000.0


@dataclass(frozen=True)
class Size:
    """Estimates for a run."""

    memory_bytes: float
    disk_bytes: float
    cause: str  # What the size comes from, for the message: numbers that the configuration states


@dataclass(frozen=True)
class SceneCounts:
    """Expected numbers of a scene."""

    # `frames`, `detections`: Of all cameras together; detections include false ones.
    frames: float
    detections: float
    clutter: float  # False detections
    # `objects`, `alive`: Objects of the scene, and those that exist at a time.
    objects: float
    alive: float
    truths: float  # Times at which the truth is stated


def counts_of_scene(loaded: LoadedConfig) -> SceneCounts:
    """Return the expected numbers of a scene of a configuration with a ``simulate`` section and cameras."""
    settings = loaded.config.simulate
    assert settings is not None
    duration = settings.duration_s
    rates = [camera.frame_rate_hz or settings.frame_rate_hz for camera in loaded.cameras.values()]
    drawn = settings.objects
    births = 0.0 if drawn is None else drawn.births_per_s * duration
    points = sum(len(body.points) for body in settings.bodies)
    count = len(settings.given) + points + (0 if drawn is None else drawn.count) + births
    lifetime = duration if drawn is None or drawn.mean_lifetime_s is None else min(drawn.mean_lifetime_s, duration)
    alive = count - births + births * min(1.0, lifetime / duration)
    frames = duration * sum(rates)
    clutter = sum(
        duration * rate * camera.detector.clutter_per_frame
        for rate, camera in zip(rates, loaded.cameras.values(), strict=True)
    )
    truths = duration * (settings.truth_rate_hz or sum(rates))
    return SceneCounts(frames, frames * alive + clutter, clutter, count, alive, truths)


def size_of_simulation(loaded: LoadedConfig, runs: int = 1, kept: bool = True) -> Size:
    """Estimate the size of `runs` scenes of a ``simulate`` section with cameras; their files are written if `kept`."""
    scene = counts_of_scene(loaded)
    states = scene.frames * scene.alive
    share = min(1.0, INSTANTS_PER_WINDOW / max(scene.frames, 1.0))
    memory = share * (states * _STATE_MEMORY + scene.detections * _DETECTION_MEMORY) + scene.objects * _OBJECT_MEMORY
    disk = scene.detections * _DETECTION_FILE + scene.truths * scene.alive * _TRUTH_FILE if kept else 0.0
    each = "1 run of" if runs == 1 else f"{runs:.3g} runs, each of"
    cause = f"{each} {scene.frames:.3g} frames, {scene.objects:.3g} objects and {scene.clutter:.3g} false detections"
    return Size(memory + runs * _RUN_MEMORY, runs * disk, cause)


def size_of_experiment(loaded: LoadedConfig, runs: int, parts: int, work_bytes: float = 0.0) -> Size:
    """Estimate the size of an experiment: its scenes, what its scenario does with them, and the bookkeeping.

    `runs` is the number of runs of each part, `parts` that of the parts: methods in cases. `work_bytes` is the memory
    that the work of a run needs besides making its scene.
    """
    total = runs * parts
    scenes = Size(0.0, 0.0, "1 run" if total == 1 else f"{total:.3g} runs")
    if loaded.config.simulate is not None:
        scenes = size_of_simulation(loaded, total, kept=False)
    return Size(scenes.memory_bytes + total * _RUN_MEMORY + work_bytes, total * _RUN_FILE, scenes.cause)


def check_size(size: Size, where: str, folder: Path | str, confirmed: bool = True) -> None:
    """Refuse a run that does not fit, and one that fills much of the disk and is not confirmed.

    `where` names the configuration, for the message; `folder` is that of the outputs. If `confirmed`, the user accepts
    any disk space. Raises InputError if the run does not fit into the memory or on the disk, and SizeError if it is
    very large and not confirmed.
    """
    memory, disk = available_memory(), free_disk(Path(folder))
    if size.memory_bytes > memory:
        raise InputError(
            f"{where}: expected a run that fits into the memory ({_bytes(memory)} available), found one of about "
            f"{_bytes(size.memory_bytes)} ({size.cause})"
        )
    if size.disk_bytes > disk:
        raise InputError(
            f"{where}: expected a run that fits on the disk ({_bytes(disk)} free), found one of about "
            f"{_bytes(size.disk_bytes)} ({size.cause})"
        )
    if not confirmed and size.disk_bytes > LARGEST_DISK_BYTES:
        raise SizeError(
            f"{where}: this takes about {_bytes(size.disk_bytes)} on the disk ({size.cause}); use `force_size=True` to "
            "run it"
        )


def available_memory() -> float:
    """Return the memory that this process may still use, in bytes; infinity where the system does not report it."""
    limits = [float("inf")]
    with contextlib.suppress(OSError, ValueError, StopIteration):
        with open("/proc/meminfo", encoding="ascii") as stream:
            line = next(line for line in stream if line.startswith("MemAvailable"))
        limits.append(1024.0 * float(line.split()[1]))
    with contextlib.suppress(OSError, ValueError):  # a container; "max": no limit
        limits.append(float(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    if len(limits) == 1:
        with contextlib.suppress(OSError, ValueError, AttributeError):
            limits.append(float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE"))
    return min(limits)


def free_disk(folder: Path) -> float:
    """Return the free disk space of a folder, or of the first folder above it that exists, in bytes.

    A file system without a size, such as ``/proc``, is not full, but cannot be written: infinity, so that the write
    fails and names its own cause.
    """
    for place in (folder, *folder.absolute().parents):
        with contextlib.suppress(OSError):
            usage = shutil.disk_usage(place)
            return float(usage.free) if usage.total else float("inf")
    return float("inf")


def _bytes(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000.0:
            return f"{count:.3g} {unit}"
        count /= 1000.0
    return f"{count:.3g} TB"
