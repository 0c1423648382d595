"""The command line: help, usage errors, exit codes, and what goes to stdout and stderr."""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

import stereophd
import stereophd.commands.simulate
from stereophd.cli.error_document import error_document
from stereophd.cli.options import GROUPS
from stereophd.errors import GateError, InputError

from .conftest import CONFIG, Outcome, start, write_config, write_log

Call = Callable[..., Outcome]
NAMES = (
    "demo", "import", "init", "info", "check", "simulate", "track", "watch", "calibrate", "align", "evaluate",
    "evaluate-cameras", "report", "export", "experiment", "compile", "config",
)  # fmt: skip
COMMANDS = [[], *([name] for name in NAMES), *(["config", c] for c in ("show", "check", "schema"))]

HEAVY = {"numpy", "numba", "scipy", "pyarrow", "matplotlib", "pandas", "yaml", "joblib"}


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help(call: Call, command: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """At the usual width no line is longer, and no summary is cut."""
    monkeypatch.setenv("COLUMNS", "80")
    outcome = call(*command, "--help")
    assert outcome.code == 0
    usage, *lines = outcome.out.splitlines()
    assert usage.startswith(f"Usage: {' '.join(['stereophd', *command])}")
    assert outcome.err == ""
    assert not [line for line in lines if len(line) > 80 or line.endswith("...")]


def test_help_names_all_commands(call: Call) -> None:
    listed, _, examples = call("--help").out.partition("Commands:\n")[2].partition("\n\n")
    assert tuple(line.split()[0] for line in listed.splitlines()) == NAMES
    assert examples.startswith("Start here:\n  stereophd demo out\n")


def test_every_help_ends_with_an_example_that_is_a_command_line(call: Call) -> None:
    """Words in the examples are a command, and options that it has; every group of options has a command."""
    groups: set[str] = set()
    for command in COMMANDS:
        if command in ([], ["config"]):
            continue
        text, _, examples = call(*command, "--help").out.rpartition("Example")
        lines = [line.split() for line in examples.splitlines()[1:]]
        assert lines, command
        for words in lines:
            assert words[1 : 1 + len(command)] == command
            assert {word for word in words if word.startswith("--")} <= set(re.findall(r"--[\w-]+", text))
        groups |= {heading for heading in GROUPS if f"\n{heading}:\n" in text}
        assert "<" not in text.splitlines()[0]
        assert "{" not in text.splitlines()[0]
    assert groups == set(GROUPS)


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys; from stereophd.cli.app import run; run(['evaluate', '--help']);"
        "print(','.join(sorted({name.split('.')[0] for name in sys.modules})), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not HEAVY & set(done.stderr.strip().split(","))


def test_track_imports_only_what_it_needs(tmp_path: Path) -> None:
    """Pandas (which Arrow's own conversions load) and trees of neighbours would add 0.3 s to each short run."""
    data = Path(__file__).resolve().parents[2] / "sample_data"
    words = [
        "track",
        f"{data / 'hall.yaml'}",
        f"{data / 'hall' / 'detections.parquet'}",
        "--out",
        f"{tmp_path / 'out'}",
    ]
    script = (
        f"import sys; from stereophd.cli.app import run; code = run({words!r});"
        "print(code, *sorted({'.'.join(name.split('.')[:2]) for name in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    code, *loaded = done.stdout.splitlines()[-1].split()
    assert code == "0"
    assert "stereophd.pipeline" in loaded
    assert not {"pandas", "matplotlib", "scipy.spatial", "scipy.stats", "scipy.optimize"} & set(loaded)


def test_version(call: Call) -> None:
    assert call("--version") == Outcome(0, f"stereophd {stereophd.__version__}\n", "")


@pytest.mark.parametrize("command", [[], ["config"]])
def test_without_words_the_help_is_shown(call: Call, command: list[str]) -> None:
    outcome = call(*command)
    assert outcome.code == 2
    assert outcome.out == ""
    assert outcome.err.startswith("Usage: ")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["trakc"], "No such command 'trakc'"),
        (["track"], "Missing argument 'CONFIG'"),
        (["track", "a", "b"], "--out: expected a folder, found none"),
        (["track", "a", "b", "--out", "c", "--treads", "2"], "--treads"),
        (["simulate", "a", "b", "--out", "d"], "unexpected extra argument"),
        (["simulate", "a", "--out", "b", "--seed", "x"], "--seed"),
        (["evaluate", "a", "b", "--base", "manhattan"], "--base"),
        (["evaluate", "a", "b", "--at", "noon"], "--at"),
    ],
)
def test_usage_errors(call: Call, words: list[str], expected: str) -> None:
    outcome = call(*words)
    assert outcome.code == 2
    assert outcome.out == ""
    assert outcome.sentence.startswith("error: ")
    assert expected in outcome.sentence
    assert outcome.sentence.endswith("--help')")


@pytest.mark.parametrize("limit", ["ospa.mean", "ospa.mean=", "=1", "ospa.mean=nan", "ospa.mean=low"])
def test_limits_of_evaluate(call: Call, limit: str) -> None:
    outcome = call("evaluate", "tracks", "truth", "--fail-above", limit)
    assert outcome.code == 2
    assert outcome.sentence == f"error: --fail-above {limit}: expected KEY=NUMBER, such as ospa.mean=0.8"


ERRORS = {
    "cameras.yaml:12: cameras.left.intrinsics.fx: expected a number > 0, found -3": (
        "cameras.yaml", 12, "cameras.left.intrinsics.fx", "a number > 0", "-3"
    ),
    "log.parquet: row 3: column u_px: expected a finite number, found nan": (
        "log.parquet", None, "row 3: column u_px", "a finite number", "nan"
    ),
    "a.yaml: there is no such file": ("a.yaml", None, None, "a file", "none"),
    "--set filter.kid=3: filter.kid: unknown key; did you mean kind?": (
        None, None, "--set filter.kid=3: filter.kid", "kind", "an unknown key"
    ),
    "not a sentence of that form": (None, None, None, None, None),
}  # fmt: skip


@pytest.mark.parametrize("message", ERRORS)
def test_parts_of_an_error(message: str) -> None:
    found = error_document(message, "input", 2)["error"]
    assert (found["message"], found["kind"], found["exit_code"], found["others"]) == (message, "input", 2, [])
    assert tuple(found[key] for key in ("file", "line", "place", "expected", "found")) == ERRORS[message]


@pytest.mark.parametrize(
    ("words", "place", "expected", "found"),
    [
        (["track", "a", "b", "--out", "c", "--jobs", "0"], "--jobs", "at least 1", "0"),
        (["simulate", "a", "--out", "b", "--runs", "-1"], "--runs", "at least 1", "-1"),
        (["evaluate", "a", "b", "--ospa2-window", "0"], "--ospa2-window", "at least 1", "0"),
        (["simulate", "a", "--out", "b", "--seed", "x"], "--seed", "a valid integer", "x"),
        (["track", "a", "b"], "--out", "a folder", "none (see 'stereophd track --help')"),
        (["track", "a", "b", "--out", "c", "--treads"], "--treads", "a known option", "--treads"),
        (["trakc"], "trakc", "a known command", "trakc"),
        (["simulate", "a", "b", "--out", "d"], None, "no further argument", "b"),
    ],
)
def test_parts_of_a_usage_error(call: Call, words: list[str], place: str | None, expected: str, found: str) -> None:
    document = json.loads(call(*words, "--json").out)["error"]
    assert document["place"] == place
    assert re.fullmatch(expected, document["expected"])
    assert document["found"] in (found, None)  # some versions of typer do not name the value


def test_errors_with_json_are_one_document(call: Call, config: Path, tmp_path: Path) -> None:
    for words, kind, file in (
        (["config", "show", tmp_path / "none.yaml", "--json"], "input", str(tmp_path / "none.yaml")),
        (["track", config, "--json", "--no-such-option"], "usage", None),
        (["evaluate", tmp_path / "a.parquet", config, "--json", "-q"], "input", str(tmp_path / "a.parquet")),
    ):
        outcome = call(*words)
        found = json.loads(outcome.out)["error"]
        assert outcome.code == found["exit_code"] == 2
        assert (found["kind"], found["file"]) == (kind, file)
        assert outcome.sentence == f"error: {found['message']}"
    assert call("config", "show", tmp_path / "none.yaml").out == ""


@pytest.mark.parametrize(
    ("error", "code", "sentence"),
    [
        (
            InputError("log: row 3: expected this, found that"),
            2,
            "error: log: row 3: expected this, found that",
        ),
        (GateError("ospa.mean is 3, limit 2"), 1, "error: ospa.mean is 3, limit 2"),
        (KeyboardInterrupt(), 130, "interrupted; no output is left half written"),
        (SystemExit(143), 143, None),
        (PermissionError(errno.EACCES, "Permission denied", "a.txt"), 2, "error: a.txt: Permission denied"),
        (
            ZeroDivisionError("division\nby zero"),
            3,
            "internal error: ZeroDivisionError: division by zero (run with --debug for the traceback)",
        ),
        (OSError("odd"), 3, "internal error: OSError: odd (run with --debug for the traceback)"),
        (MemoryError(), 2, "error: not enough memory"),
    ],
)
def test_exit_codes(
    call: Call,
    config: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    code: int,
    sentence: str | None,
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(stereophd.commands.simulate, "simulate", fail)
    outcome = call("simulate", config, "--out", tmp_path / "out")
    assert outcome.code == code
    assert outcome.out == ""
    assert outcome.err == (f"{sentence}\n" if sentence else "")
    documented = call("simulate", config, "--out", tmp_path / "out", "--json")
    if sentence is not None:
        assert json.loads(documented.out)["error"]["exit_code"] == code


def test_debug_shows_the_traceback(call: Call, tmp_path: Path) -> None:
    outcome = call("config", "check", tmp_path / "nothing.yaml", "--debug")
    assert outcome.code == 2
    assert outcome.err.startswith("Traceback")
    assert outcome.err.splitlines()[-1] == f"error: {tmp_path / 'nothing.yaml'}: there is no such file"


class TestConfig:
    def test_show_prints_what_loads_to_the_same(self, call: Call, config: Path, tmp_path: Path) -> None:
        shown = call("config", "show", config, "--set", "filter.merge_distance=4", "--seed", "8")
        assert shown.code == 0
        values = yaml.safe_load(shown.out)
        assert values["filter"]["merge_distance"] == 4.0
        assert values["seed"] == 8
        assert values["input"] == {"on_bad_row": "error", "image_margin_px": 10.0, "leave_out": {}}
        (tmp_path / "copy.yaml").write_text(shown.out)
        assert call("config", "show", tmp_path / "copy.yaml").out == shown.out

    @pytest.mark.parametrize("flag", ["-q", "-v", "-vv"])
    def test_common_flags(self, call: Call, config: Path, flag: str) -> None:
        assert call("config", "show", config, flag).out.startswith("# sha256 ")
        assert call("config", "schema", flag).code == call("config", "check", config, flag).code == 0

    def test_a_kind_is_missing(self, call: Call, config: Path) -> None:
        sentence = call("config", "show", config, "--set", "filter={}").sentence
        assert "expected a key kind that selects the kind, found none" in sentence

    def test_show_json(self, call: Call, config: Path) -> None:
        values = json.loads(call("config", "show", config, "--json").out)
        assert list(values["cameras"]) == ["left", "right"]

    def test_check(self, call: Call, config: Path) -> None:
        assert call("config", "check", config).out == f"{config}: ok (cameras: left, right; length in cm)\n"
        assert json.loads(call("config", "check", config, "--json").out)["ok"] is True
        assert call("config", "check", config, "--quiet") == Outcome(0, "", "")

    def test_schema(self, call: Call) -> None:
        schema = json.loads(call("config", "schema").out)
        assert json.loads(call("config", "schema", "--json").out) == schema
        assert set(CONFIG) <= set(schema["properties"])


class TestStreams:
    def test_json_is_one_document_on_stdout(self, call: Call, config: Path, tmp_path: Path) -> None:
        outcome = call("simulate", config, "--out", tmp_path / "out", "--json")
        assert outcome.code == 0
        assert json.loads(outcome.out)["frames"] == 40
        assert outcome.err == ""

    def test_quiet_says_nothing(self, call: Call, config: Path, tmp_path: Path) -> None:
        assert call("simulate", config, "--out", tmp_path / "out", "-q") == Outcome(0, "", "")

    def test_piped_output_has_no_colour_and_no_bar(self, config: Path, tmp_path: Path) -> None:
        process = start("simulate", config, "--out", tmp_path / "out")
        out, err = process.communicate()
        assert process.returncode == 0
        assert "\x1b" not in out + err
        assert "frames: 40" in out.splitlines()
        assert [line for line in err.splitlines() if not line.startswith("compiling kernels")] == []

    @pytest.mark.parametrize("closed", ["0<&-", "1>&-", "2>&-", "0<&- 1>&- 2>&-"])
    def test_a_closed_stream_is_no_internal_error(self, config: Path, tmp_path: Path, closed: str) -> None:
        words = [sys.executable, "-m", "stereophd", "simulate", str(config), "--out", str(tmp_path / "out")]
        process = subprocess.run(["sh", "-c", f"exec {shlex.join(words)} {closed}"], capture_output=True, text=True)
        assert process.returncode == 0, process.stdout + process.stderr
        assert "error" not in process.stdout + process.stderr
        assert (tmp_path / "out" / "detections.parquet").is_file()

    def test_a_closed_pipe_is_no_internal_error(self, config: Path) -> None:
        process = start("config", "schema")
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.wait() == 141
        assert process.stderr.read() == ""
        process.stderr.close()


def test_outputs_of_an_earlier_run_need_force(call: Call, config: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call("simulate", config, "--out", out, "-q").code == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    again = call("simulate", config, "--out", out, "--seed", "9", "-q")
    assert again.code == 2
    assert again.sentence.endswith("use --force to replace it")
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert call("simulate", config, "--out", out, "--seed", "9", "--force", "-q").code == 0
    assert {path.name for path in out.iterdir()} == set(before)
    assert (out / "truth.parquet").read_bytes() != before["truth.parquet"]


@pytest.mark.parametrize("plain_locale", [True, False])
def test_names_outside_ascii(call: Call, tmp_path: Path, plain_locale: bool) -> None:
    name = tmp_path / "é\udcff"
    name.mkdir()
    config = write_config(name / "ü.yaml")
    log = write_log(name / "log.parquet")
    words = ("track", config, log, "--out", name / "aus", "--json")
    if plain_locale:
        process = start(*words, env={**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"})
        out, err = process.communicate()
        code = process.returncode
    else:
        outcome = call(*words)
        code, out, err = outcome.code, outcome.out, outcome.err
    assert code == 0, err
    assert json.loads(out)["report_version"] == 1
    assert len(list((name / "aus").iterdir())) == 3


def test_warnings_of_libraries_go_to_the_log(tmp_path: Path) -> None:
    program = "import warnings; from stereophd.cli import app; app.run = lambda: warnings.warn('odd') or 0; app.main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
