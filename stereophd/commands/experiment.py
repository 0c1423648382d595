"""Monte Carlo experiments: many runs of a scenario, several methods and cases, on one machine or a cluster.

Each run has its own random streams, which follow from the seed and the number of the run: the results do not depend on
the number of workers, to the bit, and all methods see the same data. Finished runs are kept in the output folder until
all are done.
"""

from pathlib import Path

from stereophd.commands.options import ExperimentOptions
from stereophd.config.loading import LoadedConfig
from stereophd.experiments.engine import results as result_files
from stereophd.experiments.engine.execution import execute, read_runs, unfinished_experiment
from stereophd.experiments.engine.summary import check_quantities
from stereophd.experiments.engine.work import BOUND_METHOD, BOUND_RUN, experiment_section, memory_of, plan_parts
from stereophd.io.outputs.atomic import OutputFolder
from stereophd.io.outputs.locks import output_lock
from stereophd.options import takes
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.pipeline.runs.sizes import check_size, size_of_experiment
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES
from stereophd.report.installed import can_draw
from stereophd.wording import LOGGER

FIGURE_FILES = ("figure.png", "figure.svg")
FILES = (result_files.RUNS_FILE, result_files.SUMMARY_FILE, result_files.TIMING_FILE, *FIGURE_FILES)


@takes(ExperimentOptions)
def experiment(
    loaded: LoadedConfig, out_dir: Path | str, *, options: ExperimentOptions, progress: Progress = ignore
) -> result_files.Results:
    """Run an experiment, and write ``runs.parquet``, ``summary.parquet``, ``timing.json`` and the figure.

    Finished runs are kept in the output folder until all are done; `progress` is called with their number and the
    total. Raises InputError if the configuration lacks something, a setting of a method or case is wrong, the folder
    cannot be used, or no scheduler answers; StereophdError if a run failed again and again: finished runs are kept.
    """
    settings = experiment_section(loaded)
    parts = plan_parts(loaded, settings)
    out = Path(out_dir)
    size = size_of_experiment(loaded, settings.runs, len(parts), memory_of(parts))
    check_size(size, f"{loaded.path}: experiment", out)
    store = unfinished_experiment(loaded, out)
    with output_lock(out):
        if result_files.is_finished(store, loaded, options.resume, options.force, FILES):
            return result_files.read_results(loaded, settings, out)
        with store.held(options.resume, options.force):
            bound_runs = range(BOUND_RUN, BOUND_RUN + 1)
            wanted = [(part, bound_runs if part.method == BOUND_METHOD else range(settings.runs)) for part in parts]
            cells = [(part.method, part.case) for part in parts if part.method != BOUND_METHOD]
            execute(wanted, store, options.jobs, options.dask, progress, check_quantities(loaded, cells))
            results, runs = result_files.gather_results(loaded, settings, parts, read_runs(store))
            with OutputFolder(out, [*FILES, *UNFINISHED_FILES], force=True) as files:
                result_files.write_results(results, runs, loaded, files)
                _draw(results, files)
    return results


def finished_runs(loaded: LoadedConfig, out_dir: Path | str) -> int:
    """Return the number of finished runs that wait in an output folder for ``resume``."""
    return sum(result.method != BOUND_METHOD for result in read_runs(unfinished_experiment(loaded, Path(out_dir))))


def _draw(results: result_files.Results, out: OutputFolder) -> None:
    """Draw the figure, if matplotlib is installed."""
    if not can_draw():
        LOGGER.info("no figure: it needs matplotlib (pip install matplotlib)")
        return
    from stereophd.report.plots.experiment_plots import write_figure  # costly to import, and an extra

    write_figure(results, {name: out.path(name) for name in FIGURE_FILES})
