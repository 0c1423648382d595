"""The quickstart from inside the package: simulate a scene, track it, score the tracks, and write the page."""

from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import stereophd
from stereophd.commands.evaluate import evaluate
from stereophd.commands.report import report
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.errors import InputError
from stereophd.io.documents import expecting
from stereophd.io.outputs.atomic import atomic_write
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.wording import PROGRESS

CONFIG = "quickstart.yaml"
STEPS = 4
# Objects are people-sized, and this far from a track is another object, in metres.
CUTOFF_M = 1.0


def demo(out_dir: Path | str, force: bool = False, progress: Progress = ignore) -> dict[str, Any]:
    """Run the quickstart in a folder.

    The folder gets ``config.yaml``, the folders ``simulated``, ``tracked`` and ``evaluated``, and ``report.html``, for
    which the extra ``report`` must be installed. `progress` is called with the steps done and their number. Returns
    ``folder``, ``config``, ``page`` (null if plotly is not installed), ``tracks``, ``ospa_m`` and ``median_error_m``.
    Raises InputError if the folder cannot be written to, holds an earlier demonstration and `force` is not given, or
    holds a configuration or a page that is not of a demonstration.
    """
    folder = Path(out_dir)
    config, page = folder / "config.yaml", folder / "report.html"
    _check_folder(config, page)

    def begin(step: int, what: str) -> None:
        PROGRESS.info("%s, step %d of %d", what, step + 1, STEPS)
        progress(step, STEPS)

    simulated, tracked, evaluated = (folder / name for name in ("simulated", "tracked", "evaluated"))
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(config, replace=force) as temporary:
        temporary.write_text(config_text(), encoding="utf-8")
    begin(0, "the scene is simulated")
    simulate(load_config(config), simulated, force=force)
    begin(1, "kernels are compiled in a first run, and the objects are tracked")
    settings = load_config(config, ["report.associations=true"], cameras_path=simulated / "cameras.yaml")
    tracks = track(settings, simulated / "detections.parquet", tracked, force=force)
    begin(2, "the tracks are scored")
    scores = evaluate(
        tracked / "tracks.parquet",
        simulated / "truth.parquet",
        evaluated,
        cutoff=CUTOFF_M,
        cameras_path=simulated / "cameras.yaml",
        force=force,
    )
    begin(3, "the page is written")
    has_page = find_spec("plotly") is not None
    if has_page:
        report([simulated, tracked, evaluated], page, title="stereophd demo", force=force)
    return {
        "folder": str(folder),
        "config": str(config),
        "page": str(page) if has_page else None,
        "tracks": len(tracks["tracks"]),
        "ospa_m": scores["ospa"]["mean"],
        "median_error_m": scores["position_error"]["median"],
    }


def _check_folder(config: Path, page: Path) -> None:
    """Refuse to replace a configuration or a page that is not of a demonstration."""
    there = next((path for path in (config, page) if path.exists()), None)
    if there is None:
        return
    with expecting("a configuration", config):
        first = config.read_text(encoding="utf-8", errors="replace").partition("\n")[0] if config.exists() else ""
    if first != config_text().partition("\n")[0]:  # other versions of the package write it too
        raise InputError(f"{there}: expected no file, or that of a demonstration, found another; choose a new folder")


def config_text() -> str:
    """Return the configuration of the quickstart, without the line that names the schema of the source tree."""
    packaged = files(stereophd) / "data" / CONFIG
    source = packaged if packaged.is_file() else Path(stereophd.__file__).parents[1] / "configs" / CONFIG
    lines = source.read_text(encoding="utf-8").splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith("# yaml-language-server"))
