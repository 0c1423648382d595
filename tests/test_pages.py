"""The commands of tutorials and how-to pages run as they are printed, in order, in a folder made ready for the page.

Each command of README.md, docs/start and docs/howto is run here, or by another test that `ELSEWHERE` names, or the
table says why it is not run.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import yaml

import stereophd
from stereophd.cli.app import run
from stereophd.commands.demo import config_text, demo

from .conftest import leave_out_rendering

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("docs/start", "docs/howto")
PAGES = ["README.md", *sorted(p.relative_to(ROOT).as_posix() for f in FOLDERS for p in (ROOT / f).glob("*.md"))]
MINUTES = "minutes of CPU time; tests/commands/test_calibrate.py calibrates a shorter scene"
# Page -> pattern of commands -> the test that runs them, or why none does.
ELSEWHERE: dict[str, dict[str, str]] = {
    "README.md": {
        "demo out": "tests/cli/test_demo.py",
        "import csv|init study|track study|report recording": "tests/io/formats/test_tutorial.py",
    },
    "docs/start/import.md": {
        "csv detections": "test_detections_of_your_own_program",
        "session|quiet|info study": "the session of caliscope is not part of the project",
        ".*": "tests/io/formats/test_tutorial.py",
    },
    "docs/start/install.md": {"demo out": "tests/cli/test_demo.py"},
    "docs/start/gallery.md": {"calibrate|experiment": MINUTES, "demo": "tests/cli/test_demo.py"},
    "docs/start/recording.md": {
        "calibrate|evaluate-cameras|track": MINUTES,
        "init study": "tests/commands/test_init.py, without knowing the cameras",
    },
    "docs/howto/calibrate.md": {"calibrate|track|evaluate-cameras": MINUTES},
    "docs/howto/batch.md": {"calibrate": MINUTES},
    "docs/howto/gates.md": {"calibrate": MINUTES, "compile": "tests/commands/test_compile.py", "demo": "test_demo.py"},
    "docs/howto/bodies.md": {".*": "tests/commands/test_bodies.py"},
    "docs/howto/live.md": {".*": "tests/cli and tests/pipeline/live: the recording runs for minutes"},
    "docs/howto/world_frame.md": {".*": "tests/commands/test_align.py"},
}
# Commands that end with another code than 0: a gate that does not hold for the short scene of the tests.
GATES = re.compile(r"--fail-above ospa\.mean=0\.05|--strict")


def commands(page: str) -> list[list[str]]:
    """Return the command lines of a page, continued lines joined."""
    found = []
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL):
        if language not in ("sh", "yaml", ""):
            continue
        for line in re.sub(r"(\\|>)\n\s+(?=-|stereophd)", " ", block).splitlines():
            match = re.match(r"^(?:\$ |- run: +)?(stereophd .*)$", line.strip())
            if match and "..." not in line:
                found.append(shlex.split(match[1], comments=True)[1:])
    return found


def elsewhere(page: str, words: list[str]) -> bool:
    """Whether another test runs a command, or the table says why none does."""
    return any(re.search(pattern, " ".join(words)) for pattern in ELSEWHERE.get(page, {}))


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what the pages begin with: configurations, a short demonstration, logs of some days."""
    folder = tmp_path_factory.mktemp("pages")
    shutil.copytree(ROOT / "configs", folder / "configs")
    short = re.sub(r"duration_s: [\d.]+", "duration_s: 2.0", config_text())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stereophd.commands.demo.config_text", lambda: short)
        leave_out_rendering(patch)
        demo(folder / "out")
    (folder / "study").mkdir()
    (folder / "days").mkdir()
    text = (folder / "out" / "config.yaml").read_text()
    for name in ("config.yaml", "study/config.yaml"):
        (folder / name).write_text(text)
    log, truth = (folder / "out" / "simulated" / f"{name}.parquet" for name in ("detections", "truth"))
    for name in (
        "monday",
        "tuesday",
        "wednesday",
        "day",
        "detections",
        "recording/detections",
        "runs/run-1/detections",
        "runs/run-2/detections",
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(log, folder / f"{name}.parquet")
    for name in ("truth", "recording/truth", "runs/run-1/truth", "runs/run-2/truth"):
        shutil.copy(truth, folder / f"{name}.parquet")
    for name in ("tracks", "study/tracks"):
        shutil.copytree(folder / "out" / "tracked", folder / name)
    return folder


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_run(
    page: str, ready: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    wanted = [words for words in commands(page) if not elsewhere(page, words)]
    if not wanted:
        return
    folder = tmp_path / "page"
    shutil.copytree(ready, folder)
    monkeypatch.chdir(folder)
    leave_out_rendering(monkeypatch)
    for words in wanted:
        if words[0] == "demo":
            continue  # the folder of the page has the short one
        one_process = [re.sub(r"^\d+$", "1", w) if words[i - 1] == "--jobs" else w for i, w in enumerate(words)]
        code = run(one_process)
        assert code in ((0, 1) if GATES.search(" ".join(words)) else (0,)), (words, capfd.readouterr().err)


def test_what_is_run_elsewhere_is_on_the_page() -> None:
    for page, patterns in ELSEWHERE.items():
        lines = [" ".join(words) for words in commands(page)]
        for pattern, reason in patterns.items():
            assert any(re.search(pattern, line) for line in lines), (page, pattern)
            for name in re.findall(r"tests/[\w/]+\.py", reason):
                assert (ROOT / name).exists(), name


def test_detections_of_your_own_program(ready: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The section of docs/start/import.md: lines of JSON through pandas, and a table with names of its own."""
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    stereophd.export("kalibr", ready / "out" / "simulated" / "cameras.yaml", "chain.yaml")
    names = {name: f"cam{index}" for index, name in enumerate(("left", "right", "middle"))}
    chain = yaml.safe_load((tmp_path / "chain.yaml").read_text())
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump({names[name]: chain[name] for name in names}))
    frames: dict[tuple[float, str, int], list[dict[str, float]]] = {}
    for row in stereophd.Outputs(ready / "out" / "simulated", {}).table("detections").to_pylist():
        points = frames.setdefault((row["time_s"], row["camera"], row["frame"]), [])
        points += [] if row["u_px"] is None else [{"x": row["u_px"], "y": row["v_px"]}]
    lines, rows = [], ["stamp_ns,frame_id,seq,x,y"]
    for (time_s, camera, number), points in frames.items():
        frame = {"stamp": time_s, "camera": names[camera], "seq": number, "detections": points}
        lines.append(json.dumps(frame))
        rows += [f"{int(time_s * 1e9)},{camera},{number},{point['x']},{point['y']}" for point in points]
    (tmp_path / "detections.jsonl").write_text("\n".join(lines))
    (tmp_path / "detections.csv").write_text("\n".join(rows))
    text = (ROOT / "docs/start/import.md").read_text()
    (block,) = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    exec(compile(block, "docs/start/import.md", "exec"), {})
    (words,) = [words for words in commands("docs/start/import.md") if "detections.csv" in words]
    assert run(words) == 0
    log = stereophd.Outputs(tmp_path / "from_csv", {}).table("detections")
    assert set(log["camera"].to_pylist()) == {"cam0", "cam1", "middle"}
