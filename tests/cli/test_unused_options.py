"""In which use each option of the command line acts; in any other it is refused or reported, never silent."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from stereophd.cli.app import command_line
from stereophd.commands.options import OPTIONS
from stereophd.io.interchange.options import Stated
from stereophd.options import declarations
from stereophd.pipeline.workers import places

from .conftest import Outcome, write_config
from .test_import import write_calibration

Call = Callable[..., Outcome]

# Options that every use of a command accepts: where outputs go, what is printed, what goes into the configuration. They
# act, or are REPORTED.
ALWAYS = {
    "--out",
    "--json",
    "--quiet",
    "--verbose",
    "--debug",
    "--set",
    "--seed",
    "--force",
    "--ignore-size-limit",
    "--help",
}

# Command -> its further options that act in every use: those that are declared so, and those of the shell alone.
ACTING = {
    "watch": {"--host", "--port"},
    "align": {"--to"},
    "calibrate": {"--cameras", "--strict"},
    "check": {"--cameras", "--strict"},
    "compile": {"--jobs"},
    "config check": {"--cameras", "--for"},
    "config show": {"--cameras"},
    "evaluate-cameras": {"--config"},
    "import": {"--cameras"},
    "init": {"--log", "--cameras", "--length-unit", "--preset"},
    "report": {"--log", "--truth", "--title"},
    "simulate": {"--cameras", "--realtime"},
    "track": {"--cameras", "--smooth", "--associations", "--strict", "--listen"},
}
for _name, _kind in OPTIONS.items():
    if issubclass(_kind, Stated):  # each acts in the formats that read it
        continue
    _declared = {declared.flag_of(name) for name, declared in declarations(_kind).items() if not declared.use}
    ACTING[_name] = ACTING.get(_name, set()) | (_declared - ALWAYS)

# The filter of one object.
SINGLE = {"kind": "single", "prior": {"depth_range": [50, 200], "velocity_std": 1.0}}

# Options that act in some uses: the words of another use, and the sentence that the command ends with.
REFUSED = [
    (["calibrate", "CONFIG", "b", "--out", "c"], ["--dask", "d"], "--dask: expected several logs"),
    (["track", "CONFIG", "b", "--out", "c"], ["--dask", "d"], "--dask: expected several logs, or one in pieces"),
    (["track", "CONFIG", "b", "--out", "c"], ["--overlap", "3"], "--overlap: expected --pieces SECONDS too"),
    (["track", "CONFIG", "b", "--out", "c"], ["--record", "d"], "--record: expected only with -, --follow or"),
    (["track", "CONFIG", "b", "--out", "c"], ["--arrow", "d"], "--arrow: expected only with -, --follow or"),
    (["track", "CONFIG", "b", "--out", "c"], ["--mcap", "d"], "--mcap: expected only with -, --follow or"),
    (["track", "CONFIG", "b", "--out", "c"], ["--publish", "d"], "--publish: expected only with -, --follow or"),
    (["track", "CONFIG", "b"], ["--follow", "d"], "expected one of -, --follow and --listen"),
    (["simulate", "CONFIG", "--out", "c"], ["--jobs", "2"], "--jobs: expected only with --runs N, found one run"),
    (["init", "c"], ["--strict"], "--strict: expected only with --log FILE"),
    (["evaluate", "a", "b"], ["--dask", "d"], "--dask: expected only for folders of runs"),
    (["evaluate", "a", "b"], ["--jobs", "2"], "--jobs: expected only for folders of runs"),
    (["evaluate", "a", "b"], ["--plots"], "--plots: expected --out DIR"),
    (["evaluate", "a", "b"], ["--cameras", "c"], "--cameras: expected only with --log"),
    (["evaluate", "a", "b", "--out", "o", "--no-plots"], ["--cameras", "c"], "--cameras: expected only with --log"),
    (["evaluate", "a", "b"], ["--log", "c"], "--seen-by: expected --seen-by, --seen-within and --log together"),
    (["evaluate", "a", "b"], ["--seen-within", "1"], "--seen-by: expected --seen-by, --seen-within and --log together"),
    (["evaluate", "a", "b"], ["--seen-by", "1"], "--seen-by: expected --seen-by, --seen-within and --log together"),
    (["import", "csv", "TABLE", "--out", "c"], ["--p-detect", "0.5"], "--p-detect: expected only with --sigma-px"),
    (["import", "csv", "TABLE", "--out", "c"], ["--clutter", "0.5"], "--clutter: expected only with --sigma-px"),
    *(
        (["import", "csv", "TABLE", "--fps", "10", "--out", "OUT"], words, f"{words[0]}: expected an option that has")
        for words in (
            ["--box-point", "bottom"], ["--length-unit", "cm"], ["--pixels-undistorted"], ["--image-size", "9x9"],
            ["--sigma-px", "1"], ["--time-unit", "ms"], ["--min-score", "0.5"],
        )
    ),
    *(
        (["import", "opencv", "CAMERAS", "--out", "OUT"], words, f"{words[0]}: expected an option that has an effect")
        for words in (
            ["--column", "u_px=x"], ["--fps", "9"], ["--offset", "1"], ["--recorded-frames", "0:9"],
            ["--pixel-origin", "corner"], ["--rows-from", "bottom"], ["--truth", "."],
        )
    ),
    *(
        (["import", "csv", "TABLE", "--fps", "10", "--out", "OUT"], words, f"{words[0]}: expected one of the cameras")
        for words in (["--fps", "lft=9"], ["--offset", "lft=1"], ["--recorded-frames", "lft=0:9"])
    ),
    *(
        (["import", "csv", "TABLE", "--fps", "10", "--out", "OUT"], words, "--rename: expected one of the cameras left")
        for words in (["--rename", "a=b"], ["--rename", "typo=left"])
    ),
    (["import", "csv", "TIMED", "--out", "OUT"], ["--fps", "9"], "--fps: expected frame numbers of camera left"),
    (["import", "csv", "TIMED", "--out", "OUT"], ["--recorded-frames", "0:9"], "--recorded-frames: expected frame"),
    (
        ["import", "csv", "TABLE", "--fps", "10", "--no-fill-missing-frames", "--out", "OUT"],
        ["--recorded-frames", "0:9"],
        "--recorded-frames: expected --fill-missing-frames, which adds",
    ),
    (["import", "opencv", "CAMERAS", "--out", "OUT"], ["--no-fill-missing-frames"], "--fill-missing-frames: expected"),
    *(
        (["export", "opencv", "NATIVE", "--out", "OUT"], words, f"{words[0]}: expected only for tracks, found cameras")
        for words in (["--track", "1"], ["--rate", "9"], ["--tentative"])
    ),
    (["export", "csv", "TRACKS", "--out", "OUT"], ["--rate", "9"], "--rate: expected an option that has an effect"),
]  # fmt: skip

# The two commands that score.
SCORES = (
    ["evaluate", "TRACKS", "TRUTH", "--cutoff", "20"],
    ["evaluate-cameras", "NATIVE", "NATIVE"],
)

# The same for options that the contract of the command line accepts in every use: a warning, and the same outputs.
REPORTED = [
    (["track", "CONFIG", "b", "--out", "c"], ["--jobs", "2"], "--jobs does nothing here: it acts only with several"),
    (["track", "SINGLE", "b", "--out", "c"], ["--threads", "2"], "--threads does nothing here: it acts only with"),
    (["track", "CONFIG", "b", "c", "--out", "c", "--dask", "d:1"], ["--jobs", "2"], "--jobs does nothing here"),
    (["calibrate", "CONFIG", "b", "c", "--out", "c", "--dask", "d:1"], ["--jobs", "2"], "--jobs does nothing here"),
    (["experiment", "CONFIG", "--out", "c", "--dask", "d:1"], ["--jobs", "2"], "--jobs does nothing here"),
    *((use, ["--force"], "--force does nothing here: it acts only with --out DIR") for use in SCORES),
    (SCORES[0], ["--seed", "1"], "--seed does nothing here: it acts only for the scores of cameras"),
    (SCORES[1], ["--seed", "1"], "--seed does nothing here: it acts only with --config CONFIG"),
]


@pytest.fixture
def words_of(call: Call, config: Path, tmp_path: Path, without_checks: None) -> Callable[[Sequence[str]], list[str]]:
    """Return a function that puts files in the place of words in capitals; a word in small letters is no file."""

    def file(name: str) -> Path:
        if name == "TABLE":
            table = tmp_path / "points.csv"
            table.write_text("camera,frame,u_px,v_px\nleft,0,10,20\nleft,1,12,20\n")
            return table
        if name == "TIMED":
            timed = tmp_path / "timed.csv"
            timed.write_text("camera,time_s,u_px,v_px\nleft,0.0,10,20\nleft,0.1,12,20\n")
            return timed
        if name == "CAMERAS":
            return write_calibration(tmp_path / "calibration.json")
        if name == "SINGLE":
            return write_config(tmp_path / "single.yaml", filter=SINGLE)
        scene, tracked = tmp_path / "scene", tmp_path / "tracked"
        if not scene.exists():
            assert call("simulate", config, "--out", scene, "-q").code == 0
        files = {"NATIVE": "cameras.yaml", "LOG": "detections.parquet", "TRUTH": "truth.parquet"}
        if name in files:
            return scene / files[name]
        assert call("track", config, scene / "detections.parquet", "--out", tracked, "-q").code == 0
        return tracked / "tracks.parquet"

    def function(words: Sequence[str]) -> list[str]:
        known = {"CONFIG": config, "OUT": tmp_path / "out"}
        return [str(known.get(word) or file(word)) if word.isupper() else word for word in words]

    return function


@pytest.mark.parametrize(("use", "stated", "sentence"), REFUSED)
def test_an_option_that_would_do_nothing_is_refused(
    call: Call, words_of: Callable[..., list[str]], tmp_path: Path, use: list[str], stated: list[str], sentence: str
) -> None:
    outcome = call(*words_of(use), *stated)
    assert outcome.code == 2
    assert outcome.sentence.startswith(f"error: {sentence}")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("use", "stated", "sentence"), REPORTED)
def test_an_option_that_every_use_accepts_is_reported_where_it_does_nothing(
    call: Call,
    words_of: Callable[..., list[str]],
    monkeypatch: pytest.MonkeyPatch,
    use: list[str],
    stated: list[str],
    sentence: str,
) -> None:
    monkeypatch.setattr(places, "CONNECT_S", 0.2)  # no scheduler answers
    words = words_of(use)
    assert f"WARNING: {sentence}" in call(*words, *stated).err
    assert sentence not in call(*words).err


@pytest.mark.parametrize("new", ["left", "right"])
def test_a_camera_that_the_source_does_not_have_is_not_renamed(
    call: Call, words_of: Callable[..., list[str]], tmp_path: Path, new: str
) -> None:
    words = words_of(["import", "csv", "TABLE", "--fps", "10", "--out", "OUT"])
    outcome = call(*words, "--rename", f"typo={new}")
    assert outcome.code == 2
    expected = f"--rename: expected one of the cameras left of {tmp_path / 'points.csv'}, found typo"
    assert outcome.sentence.startswith(f"error: {expected}")
    assert call(*words, "--rename", f"left={new}").code == 0


@pytest.mark.usefixtures("without_checks")
def test_a_log_has_the_same_tracks_with_jobs(call: Call, config: Path, log: Path, tmp_path: Path) -> None:
    for name, words in (("one", []), ("two", ["--jobs", "2"])):
        outcome = call("track", config, log, "--out", tmp_path / name, "-q", *words)
        assert (outcome.code, outcome.err) == (0, "")
    first, second = ((tmp_path / name / "tracks.parquet").read_bytes() for name in ("one", "two"))
    assert first == second


@pytest.mark.parametrize("use", SCORES)
def test_scores_are_the_same_with_options_that_are_reported(
    call: Call, words_of: Callable[..., list[str]], use: list[str]
) -> None:
    words = words_of(use)
    plain, stated = call(*words, "--json"), call(*words, "--json", "--force", "--seed", "1")
    assert (plain.code, stated.code) == (0, 0)
    for one in (plain, stated):
        json.loads(one.out)
    assert stated.err.count("does nothing here") == 2


def test_a_warning_about_the_command_line_is_no_finding(call: Call, words_of: Callable[..., list[str]]) -> None:
    words = words_of(["track", "CONFIG", "LOG", "--out", "OUT"])
    plain = call(*words, "--strict")
    stated = call(*words, "--force", "--strict", "--jobs", "2")
    assert "--jobs does nothing here" in stated.err
    assert stated.code == plain.code == 0


def test_no_option_is_said_to_act_and_refused() -> None:
    """An option of every use is in no use refused; one that acts in every use is in no use reported either."""
    refused, reported = (
        {(use[0], words[0].replace("--no-", "--")) for use, words, _ in table} for table in (REFUSED, REPORTED)
    )
    assert not {(name, option) for name, option in refused if option in ALWAYS}
    acting = {(name, option) for name, options in ACTING.items() for option in options}
    assert not acting & (refused | reported)
    assert not refused & reported


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["track", "CONFIG", "-", "--pieces", "9"], "--pieces"),
        (["simulate", "CONFIG", "--realtime", "--runs", "2"], "--runs"),
    ],
)
def test_what_is_for_recordings_that_have_ended_is_refused(
    words: list[str], option: str, call: Call, config: Path
) -> None:
    result = call(*(str(config) if word == "CONFIG" else word for word in words))
    assert result.code == 2
    assert result.err.startswith(f"error: {option}: expected only")


def test_every_option_is_in_a_table() -> None:
    """An option acts in every use of its command, or a use in which it would not act is tried above."""
    commands = {}
    for name, command in command_line().commands.items():
        parts = getattr(command, "commands", None)
        commands |= {name: command} if parts is None else {f"{name} {part}": one for part, one in parts.items()}
    tried = {(use[0], words[0].replace("--no-", "--")) for use, words, _ in (*REFUSED, *REPORTED)}
    for name, command in commands.items():
        options = {parameter.opts[0] for parameter in command.params if parameter.opts[0].startswith("-")}
        acting = ALWAYS | ACTING.get(name, set())
        missing = {option for option in options - acting if (name, option) not in tried}
        assert not missing, f"{name}: {', '.join(sorted(missing))}"
        assert ACTING.get(name, set()) <= options
