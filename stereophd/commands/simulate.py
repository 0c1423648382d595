"""Simulate the scene of a configuration: the truth, the cameras, and the log of their detections.

Each run has its own random streams, one for the objects and one for each camera (`numpy.random.SeedSequence`). Run k
therefore does not depend on the number of runs or workers; a single run is run 0.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.commands.options import SimulateOptions
from stereophd.config.loading import LoadedConfig
from stereophd.config.simulate import SimulateConfig
from stereophd.core.arrays import Array
from stereophd.core.numerics.random_streams import RUN_FRAMES, RUN_GUESS, RUN_OBJECTS
from stereophd.core.simulation.detections import CLUTTER_ID, Scene, simulate_frames, truth_rows
from stereophd.io.cameras.writing import write_cameras
from stereophd.io.logs.rows import LogWriter
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.provenance import provenance, to_metadata
from stereophd.io.streams.messages import Message
from stereophd.io.tables.schemas import TRUTH
from stereophd.io.tables.writing import TableWriter
from stereophd.options import takes
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.pipeline.runs.sizes import check_size, size_of_simulation
from stereophd.pipeline.simulation import build_scene, simulate_section

DETECTIONS_FILE = "detections.parquet"
TRUTH_FILE = "truth.parquet"
CAMERAS_FILE = "cameras.yaml"
# Written only if the configuration has a section `calibration`: cameras that differ from the true ones by a draw from
# its priors.
GUESS_FILE = "guess.yaml"
FILES = (DETECTIONS_FILE, TRUTH_FILE, CAMERAS_FILE, GUESS_FILE)

# Frames between two calls of `progress`.
PROGRESS_EVERY = 500


@takes(SimulateOptions)
def simulate(
    loaded: LoadedConfig, out_dir: Path | str, *, options: SimulateOptions, progress: Progress = ignore
) -> dict[str, Any]:
    """Simulate the scene of a configuration, and write ``detections.parquet truth.parquet cameras.yaml``.

    With a section ``calibration`` also ``guess.yaml``: cameras that differ from the true ones by a draw from its
    priors. Several runs go into the folders ``run-0000``, ``run-0001``, ...; all appear together or not at all.
    `progress` is called with (done, total): frames of one run, runs of several. Returns ``runs``, ``seed``,
    ``duration_s``, ``cameras`` (names), and sums over the runs: ``frames``, ``detections`` (rows with a pixel),
    ``clutter`` (false ones among them), ``objects``. Raises InputError if there is no ``simulate`` section, no object
    fits into the view, the number of runs or jobs is bad, or the output folder cannot be used.
    """
    config, settings, runs = loaded.config, check_simulation(loaded), options.runs
    check_size(size_of_simulation(loaded, runs or 1), f"{loaded.path}: simulate", out_dir, options.force_size)
    if runs is None:
        with OutputFolder(out_dir, FILES, options.force) as out:
            counts = [_simulate_run((loaded, 0, {name: out.path(name) for name in FILES}), progress)]
    else:
        with OutputFolder(out_dir, [f"run-*/{name}" for name in FILES], options.force) as out:
            paths = [{name: out.path(f"run-{run:04d}/{name}") for name in FILES} for run in range(runs)]
            counts = _simulate_runs(loaded, paths, options.jobs, progress)
    return {
        "runs": runs or 1,
        "seed": config.seed,
        "duration_s": settings.duration_s,
        "cameras": list(loaded.cameras),
        **{key: sum(count[key] for count in counts) for key in counts[0]},
    }


def play_frames(loaded: LoadedConfig) -> Iterator[str]:
    """Yield frames of run 0 as `stereophd.io.streams.messages`, each at its time in the scene; errors as `simulate`."""
    check_simulation(loaded)
    scene = build_scene(loaded.config, loaded.build_cameras(), RUN_OBJECTS.seed(loaded.config.seed, 0))
    began_s: float | None = None
    for frame in simulate_frames(scene, RUN_FRAMES.seed(loaded.config.seed, 0)):
        camera = scene.cameras[frame.camera]
        true_s = camera.clock.to_true(frame.log_time_s)
        began_s = time.monotonic() - true_s if began_s is None else began_s
        time.sleep(max(began_s + true_s - time.monotonic(), 0.0))
        yield Message(camera.name, frame.frame, frame.log_time_s, frame.pixels).to_line()


def check_simulation(loaded: LoadedConfig) -> SimulateConfig:
    """Return the section ``simulate``, before anything is written.

    Raises InputError if there is no such section or no camera, or the section ``calibration`` does not fit the cameras.
    """
    settings = simulate_section(loaded)
    loaded.build_cameras()
    if loaded.config.calibration is not None:
        # only here, as in `_simulate_run`
        from stereophd.pipeline.calibration.configured_unknowns import build_parameters

        build_parameters(loaded)
    return settings


def _simulate_runs(
    loaded: LoadedConfig, paths: list[dict[str, Path]], jobs: int, progress: Progress
) -> list[dict[str, int]]:
    tasks = [(loaded, run, files) for run, files in enumerate(paths)]
    from stereophd.pipeline.workers.places import on_processes  # only here: a single run starts without it

    counts = []
    for count in on_processes(_simulate_run, tasks, jobs):
        counts.append(count)
        progress(len(counts), len(paths))
    return counts


def _simulate_run(task: tuple[LoadedConfig, int, dict[str, Path]], progress: Progress = ignore) -> dict[str, int]:
    """Write the files of one run of a configuration, and return how many frames, detections and objects they hold."""
    loaded, run, paths = task
    config = loaded.config
    settings = simulate_section(loaded)
    scene = build_scene(config, loaded.build_cameras(), RUN_OBJECTS.seed(config.seed, run))
    record = {**provenance("simulate", loaded.record), "run": run}
    metadata = to_metadata(record)
    described = {  # what the cameras did: with the rate that the scenario gave them
        name: camera.model_copy(update={"frame_rate_hz": camera.frame_rate_hz or settings.frame_rate_hz})
        for name, camera in loaded.cameras.items()
    }
    write_cameras(paths[CAMERAS_FILE], described, config.units.length, record)
    if config.calibration is not None:
        # only here: most scenarios have no calibration
        from stereophd.pipeline.calibration.configured_unknowns import draw_guess

        guess = draw_guess(loaded, RUN_GUESS.seed(config.seed, run))
        write_cameras(paths[GUESS_FILE], {n: guess[n] for n in described}, config.units.length, record)
    _write_truth(paths[TRUTH_FILE], scene, metadata)
    frame_seed = RUN_FRAMES.seed(config.seed, run)
    return _write_log(paths[DETECTIONS_FILE], scene, frame_seed, metadata, settings.object_id, progress)


def _write_truth(path: Path, scene: Scene, metadata: dict[bytes, bytes]) -> None:
    names = ("x", "y", "z", "vx", "vy", "vz")
    with TableWriter(path, TRUTH, metadata) as writer:
        for times_s, identifiers, states in truth_rows(scene):
            columns: dict[str, Array] = {name: states[:, index] for index, name in enumerate(names)}
            writer.append({"time_s": times_s, "object_id": identifiers, **columns})


def _write_log(
    path: Path,
    scene: Scene,
    seed: np.random.SeedSequence,
    metadata: dict[bytes, bytes],
    object_id: bool,
    progress: Progress,
) -> dict[str, int]:
    counts = {"frames": 0, "detections": 0, "clutter": 0, "objects": len(scene.objects)}
    names, total = [camera.name for camera in scene.cameras], scene.grid.frame_count()
    optional = [*(("width_px", "height_px") if scene.sized is not None else ()), *(("object_id",) if object_id else ())]
    with LogWriter(path, metadata, optional) as writer:
        for frame in simulate_frames(scene, seed):
            values: dict[str, Any] = {"object_id": frame.object_id}
            if frame.sizes is not None:
                values |= {"width_px": frame.sizes[:, 0], "height_px": frame.sizes[:, 1]}
            writer.write(frame.log_time_s, names[frame.camera], frame.frame, frame.pixels, values)
            counts["frames"] += 1
            counts["detections"] += len(frame.pixels)
            counts["clutter"] += int(np.count_nonzero(frame.object_id == CLUTTER_ID))
            # often enough for a display
            if counts["frames"] % PROGRESS_EVERY == 0 or counts["frames"] == total:
                progress(counts["frames"], total)
    return counts
