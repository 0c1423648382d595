"""Photograph the page of the quickstart scene for docs/report.md: report.png beside this file.

    python docs/figures/make_report.py

It runs the commands of README.md, and needs the extras `plot` and `report` and the browser chromium.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from PIL import Image

from stereophd.cli.app import run

FOLDER = Path(__file__).resolve().parent
CONFIG = FOLDER.parents[1] / "configs" / "quickstart.yaml"
SIZE = (1180, 880)
# The page's own time, ms, after which the picture is taken: everything has been drawn.
DRAWN_MS = 20_000


def main() -> None:
    """Make the page, and its picture."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulated, tracked, evaluated = (folder / word for word in ("simulated", "tracked", "evaluated"))
        cameras = ["--cameras", simulated / "cameras.yaml"]
        _run("simulate", CONFIG, "--out", simulated)
        _run("track", CONFIG, simulated / "detections.parquet", *cameras, "--associations", "--out", tracked)
        tables = tracked / "tracks.parquet", simulated / "truth.parquet"
        _run("evaluate", *tables, "--cutoff", "1", *cameras, "--out", evaluated)
        _run("report", simulated, tracked, evaluated, "--out", folder / "report.html")
        photograph(folder / "report.html", FOLDER / "report.png", folder)


def _run(*words: str | Path) -> None:
    if code := run([*map(str, words), "--quiet"]):
        raise SystemExit(code)


def photograph(page: Path, picture: Path, profile: Path) -> None:
    """Draw a page in a browser without a window, and keep the picture in 256 colours."""
    # The scene needs WebGL, here without a graphics card; the sandbox needs rights that containers lack.
    options = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    options += ["--hide-scrollbars", f"--user-data-dir={profile / 'browser'}", f"--window-size={SIZE[0]},{SIZE[1]}"]
    words = ["chromium", *options, f"--virtual-time-budget={DRAWN_MS}", f"--screenshot={picture}", page.as_uri()]
    subprocess.run(words, check=True, capture_output=True)
    image = Image.open(picture).convert("RGB")
    image.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(picture, optimize=True)


if __name__ == "__main__":
    main()
