"""One self-contained page about the runs in output folders."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.commands.options import ReportOptions
from stereophd.io.outputs.atomic import atomic_write
from stereophd.options import takes
from stereophd.pipeline.batch.names import expand
from stereophd.pipeline.inspection.runs import read_runs


@takes(ReportOptions)
def report(folders: Sequence[Path | str], out: Path | str, *, options: ReportOptions) -> dict[str, Any]:
    """Write one self-contained HTML page about the runs in some output folders.

    The folders are those of `track`, `calibrate`, `evaluate` and `simulate`, in any order: what belongs together is
    found by the hashes of the inputs; a log may be the folder that holds it. Returns ``page``, ``bytes``, and for each
    run ``name``, ``command`` and ``verdict``. Raises InputError if a folder holds nothing to report on, a log belongs
    to no run, the page exists and `force` is not given, or plotly is not installed.
    """
    from stereophd.report.page.document import page
    from stereophd.report.summaries import verdict

    target = Path(out)
    with atomic_write(target, replace=options.force) as temporary:
        runs = read_runs(folders, expand(options.logs or ()), options.truths or ())
        with np.errstate(all="ignore"):  # what cannot be drawn is not drawn
            text = page(runs, options.title)
        temporary.write_text(text, encoding="utf-8")
    return {
        "page": str(target),
        "bytes": len(text.encode("utf-8")),
        "runs": [
            {
                "name": run.name,
                "command": run.command,
                "verdict": verdict(run.report, None if run.evaluation is None else run.evaluation.report),
            }
            for run in runs
        ],
    }
