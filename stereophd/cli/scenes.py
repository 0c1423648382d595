"""``stereophd demo``, ``simulate`` and ``experiment``: scenes that are simulated."""

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from stereophd.cli.options import ConfigWords, Out, SceneWords, Session, argument, option
from stereophd.cli.terminal import load, print_report, progress_bar
from stereophd.cli.unused_options import refuse, report_jobs_beside_dask
from stereophd.commands.options import ExperimentOptions, Replacing, SimulateOptions
from stereophd.errors import InputError
from stereophd.site import page

Folder = Annotated[Path, argument("DIR", "Folder of the demonstration; created if missing.")]
Scene = Annotated[Path | None, option("--out", "DIR", "Output folder; created if missing.")]
RealTime = Annotated[
    bool,
    typer.Option(
        "--realtime", help="Write no files: each frame goes to standard output as a line of JSON, at its time."
    ),
]


def demo_command(session: Session, folder: Folder, replacing: Replacing) -> None:
    """Simulate, track and score a small scene, and write a page to open in a browser.

    Three cameras that are not synchronised watch a hall. The first run compiles the numerical kernels, which takes up
    to a minute.
    """
    from stereophd.commands.demo import demo

    with progress_bar(session, "demo") as progress:
        result = demo(folder, replacing.force, progress)
    print_report(session, result, lambda: _lines(folder, result))


def _lines(folder: Path, result: dict[str, Any]) -> list[str]:
    log, study = folder / "simulated" / "detections.parquet", folder / "study"
    commands = [
        ["stereophd", "init", str(study), "--log", str(log)],
        ["stereophd", "track", str(study / "config.yaml"), str(log), "--smooth", "--out", str(study / "tracks")],
    ]
    opened = (
        f"Open in a browser: {result['page']}"
        if result["page"]
        else "For a page to open in a browser: pip install plotly, then run this again with --force"
    )
    return [
        f"{result['tracks']} tracks; median error {100 * result['median_error_m']:.1f} cm, "
        f"mean OSPA {100 * result['ospa_m']:.1f} cm",
        opened,
        "Next, the same detections with settings that are estimated from them:",
        *(f"  {shlex.join(words)}" for words in commands),
        f"With your own recording: {page('start/import')}",
    ]


def simulate_command(
    session: Session, words: ConfigWords, options: SimulateOptions, out: Scene = None, realtime: RealTime = False
) -> None:
    """Simulate a scene: detections.parquet, truth.parquet and cameras.yaml.

    If the configuration has a section calibration, guess.yaml is written too: wrong cameras for calibrate.
    """
    if options.runs is None:
        refuse(session, ("jobs",), "with --runs N, found one run")
    loaded = load(words)
    if realtime:
        refuse(session, ("out", "runs", "force_size"), "without --realtime")
        from stereophd.commands.simulate import play_frames

        for line in play_frames(loaded):
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
        return
    if out is None:
        raise InputError("--out: expected a folder, found none (see 'stereophd simulate --help')")
    from stereophd.commands.simulate import simulate

    with progress_bar(session, "simulate") as progress:
        summary = simulate(loaded, out, options=options, progress=progress)
    print_report(session, summary)


def experiment_command(session: Session, words: SceneWords, out: Out, options: ExperimentOptions) -> None:
    """Run a scenario many times with several methods: runs.parquet, summary.parquet and a figure."""
    report_jobs_beside_dask(session, options.dask)
    loaded = load(words)
    from stereophd.commands.experiment import experiment, finished_runs

    try:
        with progress_bar(session, "experiment") as progress:
            results = experiment(loaded, out, options=options, progress=progress)
    except (KeyboardInterrupt, SystemExit):
        count = finished_runs(loaded, out)
        if count:
            print(f"finished runs are kept in {out} ({count}); --resume runs the others", file=sys.stderr)
        raise
    from stereophd.experiments.engine.results import report_of
    from stereophd.report.experiment_table import results_text

    print_report(session, report_of(results), lambda: results_text(results))
