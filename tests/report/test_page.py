"""The page of `report`: what belongs together, what it holds, its size, and that it works in a browser."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereophd.commands.evaluate import evaluate
from stereophd.commands.report import report
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.errors import InputError
from stereophd.pipeline.inspection.runs import Run, read_runs
from stereophd.report.page.columns import Paths, chosen, paths_of, thinned
from stereophd.report.page.document import _html, page, script_hash
from stereophd.report.summaries import run_tables, verdict
from stereophd.wording import number
from tests.commands.test_track import SCENE

pytest.importorskip("plotly", reason="the page needs plotly (the extra report)")

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

# A page with this at its head collects what the console shows ...
COLLECT = """<script>window.problems = [];
addEventListener("error", (event) => problems.push(String(event.message)));
addEventListener("unhandledrejection", (event) => problems.push(String(event.reason)));
for (const kind of ["error", "warn"]) console[kind] = (...words) => problems.push(words.join(" "));
</script>"""
# ... and with this at its end moves the slider by hand, looks at the scene before and after, and writes what it saw.
TRY = """<script>setTimeout(async () => {
const found = {}, scene = document.getElementById("scene0"), slider = document.getElementById("time");
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
try {
  const picture = () => Plotly.toImage(scene, { format: "png", width: 300, height: 200 });
  const before = JSON.stringify(scene.data[3].x), first = await picture();
  slider.focus(); found.focused = document.activeElement === slider;
  slider.value = 300; slider.dispatchEvent(new Event("input", { bubbles: true })); await wait(400);
  found.moved = JSON.stringify(scene.data[3].x) !== before;
  found.pictures_differ = (await picture()) !== first;
  found.time = document.getElementById("now").textContent;
  document.getElementById("theme").click(); await wait(400);
  found.theme = document.documentElement.dataset.theme;
  // plots are drawn when they come near the window, and all of them for the paper
  dispatchEvent(new Event("beforeprint")); await wait(200); dispatchEvent(new Event("afterprint")); await wait(200);
  const widths = () => ["lives", "ospa"].map((id) => document.getElementById(id)._fullLayout.width);
  const screen = widths(), theme = found.theme;
  dispatchEvent(new Event("beforeprint")); await wait(200);
  found.paper = { widths: widths(), theme: document.documentElement.dataset.theme };
  dispatchEvent(new Event("afterprint")); await wait(400);
  const same = JSON.stringify(widths()) === JSON.stringify(screen);
  found.restored = same && document.documentElement.dataset.theme === theme;
  found.plots = [...document.querySelectorAll(".plot")].filter((plot) => plot.data).map((plot) => plot.id);
  // the box of the scene has the diagonal of a cube, so that the viewpoints hold it, and the cameras lie in it
  const box = scene.layout.scene, axes = ["x", "y", "z"];
  found.diagonal = Math.hypot(...axes.map((a) => box.aspectratio[a]));
  const within = (q, [low, high]) => Number.isNaN(q) || (q >= low && q <= high);
  found.inside = axes.every((a) => scene.data[4][a].every((q) => within(q, box[`${a}axis`].range)));
  found.uploads = document.querySelectorAll("[data-title*=Share], [data-title*=Cloud]").length;
} catch (error) { problems.push(String(error.stack)); }
found.injected = "injected" in window;
found.problems = problems;
const out = document.createElement("pre");
out.id = "found"; out.textContent = JSON.stringify(found); document.body.append(out);
}, 500);</script>"""

INJECTED = '<script>window.injected = true</script><img src="x:y" onerror="window.injected = true">'


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log, tracked twice and evaluated once."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "scene.yaml").write_text(SCENE)
    simulate(load_config(folder / "scene.yaml"), folder / "sim")
    log = folder / "sim" / "detections.parquet"
    for name, more in (("phd", ()), ("pmb", ("filter.kind=pmb",))):
        loaded = load_config(folder / "scene.yaml", ["report.associations=true", *more])
        track(loaded, log, folder / name)
    evaluate(folder / "pmb" / "tracks.parquet", folder / "sim" / "truth.parquet", folder / "score", plots=False)
    return folder


def data_of(text: str) -> dict[str, Any]:
    """The data that a page holds."""
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert match is not None
    return dict(json.loads(match.group(1)))


def test_what_belongs_together_is_found_by_hashes(folders: Path) -> None:
    phd, pmb = read_runs([folders / name for name in ("phd", "score", "pmb", "sim")])
    assert (phd.name, pmb.name) == ("phd", "pmb")
    assert phd.evaluation is None
    assert pmb.evaluation is not None
    assert phd.log == pmb.log == folders / "sim" / "detections.parquet"
    assert phd.truth is not None
    # an evaluation whose tracks are not at hand stands by itself
    (alone,) = read_runs([folders / "score"])
    assert (alone.command, alone.tracks) == ("evaluate", None)
    assert "OSPA" in verdict(alone.report, alone.report)


def test_page_holds_everything_and_refers_to_nothing(folders: Path, tmp_path: Path) -> None:
    found = report([folders / "phd", folders / "pmb", folders / "score", folders / "sim"], tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert found["bytes"] == len(text.encode()) < 10e6
    head, rest = text.split("<script>", 1)
    assert "default-src 'none'" in head
    assert not re.search(r"<(?:script|link|img|iframe)[^>]*\s(?:src|href)=[\"']?(?:https?:)?//", text)
    shown = head + rest.split("</script>", 1)[1]
    for words in ("Runs side by side", "SHA-256", "Configuration", "seen by left", "birth:", "OSPA"):
        assert words in shown
    data = data_of(text)
    assert [run["name"] for run in data["runs"]] == ["phd", "pmb"]
    assert {"tracks", "truth", "frames", "residuals", "scans", "evaluation"} <= set(data["runs"][1])
    assert data["runs"][1]["whole_frames"]
    with pytest.raises(InputError, match="exists"):
        report([folders / "phd"], tmp_path / "page.html")


def test_the_policy_names_the_scripts_of_the_page_and_no_other(folders: Path, tmp_path: Path) -> None:
    report([folders / "pmb"], tmp_path / "page.html")
    text = (tmp_path / "page.html").read_bytes()
    run = [body for attributes, body in re.findall(rb"<script([^>]*)>(.*?)</script>", text, re.S) if not attributes]
    digests = [base64.b64encode(hashlib.sha256(body).digest()).decode() for body in run]
    policy = re.search(r"script-src ([^;]*);", text.decode())
    assert policy is not None
    assert policy[1].split() == [*(f"'sha256-{digest}'" for digest in digests), "'unsafe-eval'"]
    assert len(digests) == 2


def test_names_are_escaped(folders: Path, tmp_path: Path) -> None:
    copy = tmp_path / "<b>"
    shutil.copytree(folders / "pmb", copy)
    report([copy], tmp_path / "page.html", title="</title><script>alert(1)</script>")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "<b>" not in text.split("<script>")[0]
    assert data_of(text)["runs"][0]["name"] == "<b>"


def test_what_is_no_output_is_refused(folders: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="with a report"):
        report([tmp_path / "empty"], tmp_path / "page.html")
    with pytest.raises(InputError, match="expected an output folder"):
        report([folders / "sim"], tmp_path / "page.html")
    simulate(load_config(folders / "scene.yaml", seed=9), tmp_path / "other")
    with pytest.raises(InputError, match="none of the runs"):
        report([folders / "pmb"], tmp_path / "page.html", logs=[tmp_path / "other" / "detections.parquet"])
    for record in ({"command": "track"}, {"command": "evaluate", "config": {}, "inputs": {}, "seed": None}):
        foreign = tmp_path / str(record["command"])
        foreign.mkdir()
        (foreign / "report.json").write_text(json.dumps({"provenance": record}))
        with pytest.raises(InputError, match=r"report\.json: expected a report of"):
            report([foreign], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("pmb", ("provenance", "config", "object"), [1]),
        ("pmb", ("tracks",), [{"track_id": 1}]),
        ("score", ("ospa", "order"), 1e308),
        ("score", ("gospa",), None),
    ],
)
def test_a_report_of_another_shape_is_refused_by_its_name(
    folders: Path, tmp_path: Path, name: str, key: tuple[str, ...], value: object
) -> None:
    for folder in ("pmb", "score"):
        shutil.copytree(folders / folder, tmp_path / folder)
    path = tmp_path / name / "report.json"
    document = json.loads(path.read_text())
    place = document
    for part in key[:-1]:
        place = place[part]
    place[key[-1]] = value
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"{name}.report\.json.*: expected a report of stereophd, found"):
        page(read_runs([tmp_path / "pmb", tmp_path / "score"]))


def test_what_is_no_mapping_has_no_cameras(folders: Path, tmp_path: Path) -> None:
    shutil.copytree(folders / "pmb", tmp_path / "pmb")
    path = tmp_path / "pmb" / "report.json"
    document = json.loads(path.read_text())
    document["provenance"]["config"] = "none"
    path.write_text(json.dumps(document))
    (run,) = read_runs([tmp_path / "pmb"])
    assert run.cameras == ()


def test_a_thousand_tracks_fit_in_ten_megabytes(folders: Path) -> None:
    (run,) = read_runs([folders / "pmb"])
    rng, tracks, rows = np.random.default_rng(1), 1000, 60
    ids, times = np.repeat(np.arange(tracks), rows), np.tile(0.1 * np.arange(rows), tracks)
    columns = {name: rng.normal(0.0, 30.0, len(ids)) for name in ("x", "y", "vx", "vy", "vz", "speed", "position_std")}
    z, existence, names = rng.uniform(90.0, 180.0, len(ids)), np.ones(len(ids)), np.full(len(ids), "left", dtype=object)
    wide = {"time_s": times, "track_id": ids, "z": z, "existence": existence, **columns}
    seen = {
        "time_s": times, "camera": names, "frame": np.tile(np.arange(rows), tracks), "track_id": ids,
        "u_px": rng.uniform(0, 800, len(ids)), "v_px": rng.uniform(0, 600, len(ids)), "probability": existence,
    }  # fmt: skip
    one = {"track_id": 0, "first_s": 0.0, "last_s": 15.0, "n_estimates": rows, "n_detections": {"left": 9, "right": 9}}
    listed = [{**one, "track_id": k, "mean_existence": 1.0} for k in range(tracks)]
    many = Run("many", "track", {**run.report, "tracks": listed}, run.cameras, wide, run.scans, seen)
    text = page([many])
    assert 5e6 < len(text.encode()) < 10e6
    assert len(data_of(text)["runs"][0]["tracks"]["ids"]) == tracks


def test_paths_are_sorted_thinned_and_broken_at_gaps() -> None:
    ids = np.array([7, 3, 7, 3, 7, 7])
    times = np.array([1.0, 0.0, 2.0, 0.1, 2.0, 30.0])
    paths = paths_of(ids, {"time_s": times, "x": np.arange(6.0), "y": np.zeros(6), "z": np.zeros(6)})
    assert paths.ids.tolist() == [3, 7]
    assert paths.starts.tolist() == [0, 2, 5]
    # of two rows of one time the last one counts
    assert paths.columns["x"].tolist() == [1, 3, 0, 4, 5]
    long = Paths(np.array([0]), np.array([0, 1000]), {"time_s": np.append(np.arange(999.0), 5000.0)})
    few = thinned(long, 100)
    assert len(few.times) < 120
    assert (few.times[0], few.times[-1]) == (0.0, 5000.0)
    assert np.isnan(few.times[-2])
    assert few.times[-3] == 998.0
    # four cameras that report in bursts make no gaps
    bursts = (np.arange(40)[:, None] + 0.01 * np.arange(4)).ravel()
    assert not np.isnan(thinned(Paths(np.array([0]), np.array([0, 160]), {"time_s": bursts}), 1000).times).any()
    assert chosen(1000, 5).tolist() == [0, 250, 500, 749, 999]


def test_tables_are_rounded_and_have_units(folders: Path) -> None:
    assert [number(x) for x in (0.0, 0.0123456, 1.23456, 123456.7, None)] == ["0", "0.0123", "1.23", "123457", "-"]
    found = json.loads((folders / "pmb" / "report.json").read_text())
    tables = {table.title.split(" (")[0]: table for table in run_tables(found)}
    assert list(tables) == ["Cameras", "Tracks", "Checks"]
    assert "residual [px]" in tables["Cameras"].header
    assert "speed [cm/s]" in tables["Tracks"].header
    assert all(len(row) == len(table.header) for table in tables.values() for row in table.rows)
    short = {table.title.split(" (")[0]: table for table in run_tables(found, most_tracks=1)}["Tracks"]
    assert len(short.rows) == 1
    assert "shorter tracks" in short.notes[0]
    assert "tracks in 19.5 s from 2 cameras" in verdict(found)
    warned = {**found, "checks": [{"name": "clock.offset", "status": "warning"}], "tracks": []}
    assert verdict(warned).endswith("1 check warns: clock.offset.")


def test_the_printed_line_and_the_page_say_what_the_scale_is_known_from() -> None:
    stds = {"rotation_std_deg": 0.1, "direction_std_deg": 0.1, "center_std": 0.1}
    found = {"status": "determined", "cameras": {"left": stds}, "scale": {"determined_by": "prior"}}
    words = "scale from the first guess alone"
    assert words in verdict(found)
    assert "; scale from nothing: the distance of two cameras is 1" in verdict({**found, "length_unit": "baseline"})
    (poses,) = [
        t
        for t in run_tables({**found, "parameters": [], "provenance": {"config": {}}})
        if t.title == "Calibrated cameras"
    ]
    assert words in _html(poses)


@pytest.mark.skipif(BROWSER is None, reason="no chromium or chrome is installed")
def test_page_works_in_a_browser(folders: Path, tmp_path: Path) -> None:
    report([folders / name for name in ("pmb", "score", "sim")], tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    watched = text.replace("<style>", f"{COLLECT}<style>", 1).replace("</body>", f"{INJECTED}{TRY}</body>")
    # the policy allows the scripts of the page, now also those of this test, and no other
    ours = " ".join(script_hash(script[len("<script>") : -len("</script>")]) for script in (COLLECT, TRY))
    watched = watched.replace("script-src ", f"script-src {ours} ", 1)
    (tmp_path / "watched.html").write_text(watched, encoding="utf-8")
    command = [
        str(BROWSER), "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=6000",
        "--window-size=640,480",
        "--dump-dom", (tmp_path / "watched.html").as_uri(),
    ]  # fmt: skip
    out = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False).stdout
    match = re.search(r'<pre id="found">(.*?)</pre>', out, re.DOTALL)
    assert match is not None, out[-500:]
    found = json.loads(html.unescape(match.group(1)))
    assert found["problems"] == []
    assert found["focused"]
    assert found["moved"]
    assert found["pictures_differ"]
    assert found["time"] == "5.85 s"
    assert found["diagonal"] == pytest.approx(3.0**0.5)
    assert found["inside"]
    assert found["uploads"] == 0
    assert not found["injected"]
    assert found["theme"] == "dark"
    assert found["paper"] == {"widths": [680, 680], "theme": "light"}
    assert found["restored"]
    drawn = {"scene0", "frame", "ospa", "gospa", "lives", "values", "residual-cameras", "residual-time", "count"}
    assert drawn <= set(found["plots"])


@pytest.mark.usefixtures("without_checks")
def test_track_draws_and_prints_tables(folders: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="plots need matplotlib (the extra plot)")
    from stereophd.cli.app import run

    log, out = folders / "sim" / "detections.parquet", tmp_path / "out"
    assert run(["track", str(folders / "scene.yaml"), str(log), "--out", str(out), "--plots"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(verdict(json.loads((out / "report.json").read_text())))
    assert "residual [px]" in printed
    assert max(map(len, printed.splitlines())) < 160
    for plot in ("top", "side", "timelines", "residuals"):
        assert (out / f"{plot}.png").stat().st_size > 5000
        assert (out / f"{plot}.svg").exists()
