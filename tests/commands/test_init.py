"""`init`: a configuration from a log, and templates; ``motion.acceleration_std: estimate``."""

from __future__ import annotations

import json
import logging
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from stereophd.cli import terminal
from stereophd.cli.app import run
from stereophd.commands.evaluate import evaluate
from stereophd.commands.init import init
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_cameras, load_config, make_config
from stereophd.errors import InputError
from stereophd.pipeline.checks.finding import DO_NOT_MEET, Finding
from stereophd.pipeline.initial import acceleration
from stereophd.pipeline.initial.acceleration import _of_windows
from stereophd.pipeline.initial.draft import draft_from_log
from stereophd.pipeline.initial.template import template

ROOT = Path(__file__).parents[2]
ACCELERATION = 0.3


def simulated(folder: Path, duration_s: float) -> Path:
    """Four objects of known acceleration before the two side cameras of the quickstart."""
    values = yaml.safe_load((ROOT / "configs" / "quickstart.yaml").read_text())
    values["cameras"].pop("middle")
    values["simulate"] |= {"duration_s": duration_s, "acceleration_std": ACCELERATION}
    values["simulate"]["objects"] |= {"births_per_s": 0.0}
    simulate(make_config(values), folder)
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("scene") / "out", 4.0)


@pytest.fixture(scope="module")
def written(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("written")
    return folder, init(folder, scene / "detections.parquet")


def test_track_runs_with_what_init_writes(scene: Path, written: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    folder, report = written
    assert not [found["message"] for found in report["checks"] if found["status"] == "warning"]
    loaded = load_config(folder / "config.yaml")
    track(loaded, scene / "detections.parquet", tmp_path / "out")
    cutoff = loaded.config.evaluation.cutoff
    assert cutoff is not None
    assert 0.5 < cutoff < 2.0
    score = evaluate(tmp_path / "out" / "tracks.parquet", scene / "truth.parquet", plots=False)
    assert (score["tracks"], score["identity_switches"], score["ospa"]["cutoff"]) == (4, 0, cutoff)
    assert score["ospa"]["mean"] < 0.1


def test_the_printed_command_works_as_it_is(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From the folder in which the user stands, and with spaces in names; steps are shown meanwhile."""
    monkeypatch.setattr(terminal, "PACE_S", 0.02)
    (tmp_path / "elsewhere").mkdir()
    shutil.copytree(scene, tmp_path / "my scene")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert run(["init", "../my study", "--log", "../my scene/detections.parquet"]) == 0
    printed = capsys.readouterr()
    assert re.search(r"init, \d+ s: the acceleration is estimated, step 2 of 6\n", printed.err)
    assert "cameras are compared by their tracks, step 5 of 6" in printed.err
    name, *words = shlex.split(printed.out.splitlines()[-1])
    assert name == "stereophd"
    assert run(words) == 0
    assert (tmp_path / "my study" / "tracks" / "tracks.parquet").exists()


@pytest.mark.parametrize(("with_log", "known"), [(True, ()), (False, ()), (False, ("2",))])
def test_cameras_of_which_nothing_is_known_are_calibrated_first(
    with_log: bool, known: tuple[str, ...], scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The next command is `calibrate`, and it takes the configuration as it is: it ends without input errors."""
    values = yaml.safe_load((scene / "cameras.yaml").read_text())
    if not with_log:  # names that YAML would take for numbers
        values["cameras"] = {str(number): camera for number, camera in enumerate(values["cameras"].values(), 1)}
    for name, camera in values["cameras"].items():
        camera["pose"] = camera["pose"] if name in known else "unknown"
    guess = tmp_path / "guess.yaml"
    guess.write_text(yaml.safe_dump(values))
    log = ["--log", str(scene / "detections.parquet")] if with_log else []
    assert run(["init", str(tmp_path / "study"), "--cameras", str(guess), *log]) == 0
    name, command, config, *_ = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert (name, command) == ("stereophd", "calibrate")
    assert run(["config", "check", config, "--for", "calibrate"]) == 0
    loaded = load_config(config)
    assert loaded.config.calibration is not None
    assert loaded.config.calibration.reference == (known or tuple(loaded.cameras))[0]
    if with_log:
        words = ["calibrate", config, str(scene / "detections.parquet"), "--out", str(tmp_path / "out")]
        assert run([*words, "--time", "1", "--jobs", "1"]) == 0


def test_a_camera_of_unknown_focal_length_is_calibrated_before_anything_uses_it(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its focal length is the width of the image until then, with which `track` would run without a word."""
    values = yaml.safe_load((scene / "cameras.yaml").read_text())
    first, second = values["cameras"]
    values["cameras"][first]["intrinsics"] = {"focal": "unknown"}
    guess, log = tmp_path / "guess.yaml", str(scene / "detections.parquet")
    guess.write_text(yaml.safe_dump(values))
    assert run(["init", str(tmp_path / "study"), "--cameras", str(guess), "--log", log]) == 0
    name, command, config, *_ = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert (name, command) == ("stereophd", "calibrate")
    assert run(["config", "check", config, "--for", "calibrate"]) == 0
    priors = load_config(config).resolved["calibration"]["priors"]
    assert priors[first]["focal_std"] > 0.0 == priors[second]["focal_std"]
    for words in (["track", config, log, "--out", str(tmp_path / "tracks")], ["check", config, log]):
        assert run(words) == 2
        assert f"cameras.{first}.intrinsics.focal: expected a value, found unknown" in capsys.readouterr().err
    stated = f"calibration.priors.{first}={{principal_point_std_px: 5}}"
    assert run(["config", "check", config, "--for", "calibrate", "--set", stated]) == 2
    assert f"{first}.focal_std: expected a standard deviation" in capsys.readouterr().err


def test_times_in_milliseconds_are_named(scene: Path, tmp_path: Path) -> None:
    """The frame rates that such times give were written as those of the cameras, which then agreed with them."""
    table = pd.read_parquet(scene / "detections.parquet")
    table["time_s"] *= 1e3
    table.to_parquet(tmp_path / "log.parquet", index=False)
    described = yaml.safe_load((scene / "cameras.yaml").read_text())
    for camera in described["cameras"].values():
        del camera["frame_rate_hz"]
        camera["pose"] = "unknown"
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(described))
    report = init(tmp_path / "out", tmp_path / "log.parquet", tmp_path / "cameras.yaml")
    named = [one["camera"] for one in report["checks"] if one["cause"] == "milliseconds"]
    assert named == list(described["cameras"])


@pytest.mark.parametrize("said_by", ["likelihood", "views", "checks", "mistake"])
def test_cameras_whose_rays_do_not_meet_are_calibrated_first(
    said_by: str, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No usual mistake explains it: the next command is `calibrate`, and it takes the configuration as it is.

    The noise is that of each camera alone, whatever their rays would say of it.
    """
    values = yaml.safe_load((scene / "cameras.yaml").read_text())
    for camera in values["cameras"].values():
        del camera["detector"]
    if said_by == "mistake":
        turned = Finding("geometry.cause", "warning", "right: a turn by 8 degrees", cause=DO_NOT_MEET)
        monkeypatch.setattr("stereophd.pipeline.initial.draft._mistake", lambda _: turned)
    elif said_by != "checks":
        turn = [5.0, 30.0, 3.0] if said_by == "likelihood" else [0.0, 170.0, 0.0]
        list(values["cameras"].values())[1]["pose"]["rotation_vector_deg"] = turn
    else:
        found = Finding("geometry.rays", "warning", "the rays meet no more often than chance", cause=DO_NOT_MEET)
        monkeypatch.setattr("stereophd.commands.init.check_log", lambda *_, **__: (found,))
    (tmp_path / "guess.yaml").write_text(yaml.safe_dump(values))
    log = str(scene / "detections.parquet")
    assert run(["init", str(tmp_path / "study"), "--cameras", str(tmp_path / "guess.yaml"), "--log", log]) == 0
    name, command, config, *_ = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert (name, command) == ("stereophd", "calibrate")
    assert run(["config", "check", config, "--for", "calibrate"]) == 0
    # nobody has measured a distance, and no pose is known
    section = yaml.safe_load(Path(config).read_text())["calibration"]
    assert "scale" not in section
    assert [prior["rotation_std_deg"] for prior in section["priors"].values()] == [10.0]
    assert said_by == "checks" or "# from the depths at which rays" not in Path(config).read_text()
    for camera in load_config(config).cameras.values():
        assert camera.detector.sigma_px == pytest.approx([1.0, 1.0], rel=0.3)


@pytest.mark.parametrize("covered_after_s", [1.5, 2.5])
def test_a_camera_that_something_covers_for_a_while_is_not_wrong(
    scene: Path, tmp_path: Path, covered_after_s: float
) -> None:
    """Its empty frames are no misses of their own, each as improbable as the detector says."""
    log, cameras = pd.read_parquet(scene / "detections.parquet"), scene / "cameras.yaml"
    covered = (log["camera"] == log["camera"].iloc[0]) & (log["time_s"] > covered_after_s)
    log.loc[covered, ["u_px", "v_px"]] = np.nan
    log[~covered | ~log.duplicated(["camera", "time_s"])].to_parquet(tmp_path / "log.parquet", index=False)
    report = init(tmp_path / "study", tmp_path / "log.parquet", cameras)
    assert not report["must_be_calibrated"]


def test_three_cameras_that_do_not_agree_are_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = yaml.safe_load((ROOT / "configs" / "quickstart.yaml").read_text())
    simulate(make_config({**values, "simulate": values["simulate"] | {"duration_s": 1.0}}), tmp_path / "out")
    monkeypatch.setattr("stereophd.pipeline.initial.draft._mistake", lambda _: None)
    monkeypatch.setattr("stereophd.pipeline.initial.draft._with_tracks", lambda draft, *_: (draft, "so the log says"))
    log = tmp_path / "out" / "detections.parquet"
    draft = draft_from_log(template("m", load_cameras(log.with_name("cameras.yaml")).cameras, "lab"), log)
    first, second, third = values["cameras"]
    assert draft.findings[0].message == f"{first}, {second} and {third} do not agree: so the log says"


def test_what_is_given_stays(scene: Path, tmp_path: Path) -> None:
    """As the remedies ask for that `init` prints, where cameras state no detector."""
    values = yaml.safe_load((scene / "cameras.yaml").read_text())
    for camera in values["cameras"].values():
        del camera["detector"]
    (tmp_path / "guess.yaml").write_text(yaml.safe_dump(values))
    first, *others = values["cameras"]
    given = [f"cameras.{first}.detector.sigma_px=[4.5, 4.5]", "motion.acceleration_std=[0.3, 0.3, 0.2]"]
    init(tmp_path / "study", scene / "detections.parquet", tmp_path / "guess.yaml", given)
    loaded = load_config(tmp_path / "study" / "config.yaml")
    assert loaded.cameras[first].detector.sigma_px == (4.5, 4.5)
    assert not loaded.cameras[first].detector.estimate
    assert all(loaded.cameras[name].detector.sigma_px != (4.5, 4.5) for name in others)
    assert loaded.resolved["motion"]["acceleration_std"] == [0.3, 0.3, 0.2]


def test_noise_follows_from_one_camera_tracks_where_poses_are_unknown(scene: Path, tmp_path: Path) -> None:
    values = yaml.safe_load((scene / "cameras.yaml").read_text())
    for camera in values["cameras"].values():
        del camera["detector"]
        camera["pose"] = "unknown"
    guess = tmp_path / "guess.yaml"
    guess.write_text(yaml.safe_dump(values))
    report = init(tmp_path / "study", scene / "detections.parquet", guess)
    for detector in report["detectors"].values():
        assert detector["sigma_px"] == pytest.approx([1.0, 1.0], rel=0.3)
        assert "about one-camera tracks" in detector["source"]
    # misses and false detections are the usual ones, until there are tracks
    loaded = load_config(tmp_path / "study" / "config.yaml")
    assert loaded.estimated_cameras == list(loaded.cameras)
    # nothing shows the depths, but speeds go with those that are usual
    choices = {row["key"]: row for row in report["values"]}
    assert "not measured" in choices["filter.birth.depth_range"]["source"]
    assert "one-camera tracks swerve" in choices["motion.acceleration_std"]["source"]
    near, far = choices["filter.birth.depth_range"]["value"]
    middle = 2.0 / (1.0 / near + 1.0 / far)
    # with known cameras 0.05 of the depth per second is written
    assert 0.01 * middle < choices["filter.birth.velocity_std"]["value"] < 0.3 * middle


def test_what_the_search_for_cameras_does_not_do_is_refused_before_anything_is_written(
    scene: Path, tmp_path: Path
) -> None:
    values = yaml.safe_load((scene / "cameras.yaml").read_text())
    next(iter(values["cameras"].values()))["clock"] = {"offset_s": "unknown"}
    guess = tmp_path / "guess.yaml"
    guess.write_text(yaml.safe_dump(values))
    with pytest.raises(InputError, match=r"all poses but that of the reference are found together|clock is taken"):
        init(tmp_path / "study", None, guess)
    assert not (tmp_path / "study").exists()


def test_every_value_has_its_source(written: tuple[Path, dict[str, Any]]) -> None:
    folder, report = written
    lines = (folder / "config.yaml").read_text().splitlines()
    assert max(map(len, lines)) <= 120
    assert any("Images do not show the unit" in line for line in lines)
    loaded = load_config(folder / "config.yaml")
    for row in report["values"]:
        place: Any = loaded.resolved
        for key in row["key"].split("."):
            place = place[key]
        assert place == row["value"]
        assert row["source"]
        name = row["key"].rsplit(".", 1)[1]
        (number,) = [n for n, line in enumerate(lines) if line.strip().startswith(f"{name}: ")][-1:]
        assert lines[number - 1].strip().startswith("# ")
    assert {row["key"] for row in report["values"] if not row["measured"]} <= {"filter.survival_per_s"}


def test_acceleration_is_near_the_true_one(written: tuple[Path, dict[str, Any]]) -> None:
    found = load_config(written[0] / "config.yaml").config.motion.acceleration_std  # type: ignore[union-attr]
    assert ACCELERATION / 3.0 < found < 3.5 * ACCELERATION  # type: ignore[operator]


def test_an_estimated_acceleration_is_reported(
    scene: Path, written: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    stated = load_config(written[0] / "config.yaml")
    asked = load_config(written[0] / "config.yaml", ["motion.acceleration_std=estimate"])
    assert "acceleration_std: estimate" not in (written[0] / "config.yaml").read_text()
    report = track(asked, scene / "detections.parquet", tmp_path / "out")
    value = report["motion"]["acceleration_std"]
    assert value == pytest.approx(stated.config.motion.acceleration_std, rel=2.1)  # type: ignore[union-attr]
    assert report["provenance"]["config"]["motion"]["acceleration_std"] == value
    best = max(report["motion"]["tried"], key=lambda row: row["log_likelihood"])
    assert best["log_likelihood"] >= 0.0
    assert json.loads((tmp_path / "out" / "report.json").read_text())["motion"] == report["motion"]


def test_an_acceleration_is_not_estimated_elsewhere(scene: Path, tmp_path: Path) -> None:
    single = load_config(ROOT / "configs" / "paper" / "single_object.yaml", ["motion.acceleration_std=estimate"])
    with pytest.raises(InputError, match=r"acceleration_std: expected a number where filter\.kind is not"):
        track(single, scene / "detections.parquet", tmp_path / "out")
    with pytest.raises(InputError, match="only track estimates it"):
        single.config.motion.build()


def test_one_agile_object_among_many_at_rest_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Below the acceleration of the agile one its tracks are lost, and the likelihood rises with those at rest."""

    def likelihoods(loaded: Any, parts: Any, cameras: Any) -> np.ndarray[Any, Any]:
        value = loaded.config.motion.acceleration_std
        return np.full(100, 0.1 * max(-np.log(value / 0.3), 20.0 - 20.0 * np.log(value / 2.0) ** 2))

    monkeypatch.setattr(acceleration, "log_likelihoods", likelihoods)
    loaded = load_config(ROOT / "configs" / "quickstart.yaml")
    found = acceleration.estimate_acceleration(loaded, [[]], 0.03)
    assert found.value == pytest.approx(2.0, rel=0.8)


def test_windows_bound_the_acceleration_from_below() -> None:
    # 400 events, of which the last 25 hold a manoeuvre that the smaller values miss
    quiet = {0.1: 0.0, 0.3: -0.2, 1.0: -1.0}
    manoeuvre = {0.1: -9.0, 0.3: -4.0, 1.0: 0.0}
    likelihoods = {a: np.r_[np.full(350, quiet[a]), np.full(50, manoeuvre[a])] for a in quiet}
    assert _of_windows(likelihoods, likelihoods[0.1]) == 1.0
    likelihoods = {a: np.r_[np.full(375, quiet[a]), np.full(25, manoeuvre[a])] for a in quiet}
    assert _of_windows(likelihoods, likelihoods[0.1]) == 0.1  # one window may be anything
    # windows that differ by chance are no population: its largest value would be too large
    alike = {0.1: np.tile([0.0, -0.02], 8), 0.3: np.tile([-0.02, -0.002], 8)}
    alike = {a: np.repeat(one, 25) for a, one in alike.items()}
    assert _of_windows(alike, alike[0.1]) is None


def test_the_top_of_the_likelihood_lies_between_the_values_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    def likelihoods(loaded: Any, parts: Any, cameras: Any) -> np.ndarray[Any, Any]:
        return np.full(100, -0.5 * (np.log(loaded.config.motion.acceleration_std / 0.43) / 0.1) ** 2 / 100.0)

    monkeypatch.setattr(acceleration, "log_likelihoods", likelihoods)
    found = acceleration.estimate_acceleration(load_config(ROOT / "configs" / "quickstart.yaml"), [[]], 0.03)
    assert found.value == found.usual == 0.43
    assert found.error == pytest.approx(0.1, rel=1e-3)


def test_too_short_a_log_needs_a_number(written: tuple[Path, dict[str, Any]], scene: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(acceleration, "LEAST_EVENTS", 10_000)
    asked = load_config(written[0] / "config.yaml", ["motion.acceleration_std=estimate"])
    with pytest.raises(InputError, match="expected at least 10000 frames"):
        acceleration.with_estimated_motion(asked, scene / "detections.parquet")


@pytest.mark.parametrize(("kind", "unit"), [("animals", "cm"), ("drones", "m"), ("lab", "mm")])
def test_templates_without_a_log(kind: Any, unit: str, scene: Path, tmp_path: Path) -> None:
    report = init(tmp_path / "a", kind=kind, length_unit=unit)
    text = (tmp_path / "a" / "config.yaml").read_text()
    assert "cameras: cameras.yaml" in text
    assert not any(row["measured"] for row in report["values"] if "birth" in row["key"])
    cameras = (scene / "cameras.yaml").read_text().replace("length: m", f"length: {unit}")
    (tmp_path / "a" / "cameras.yaml").write_text(cameras)
    loaded = load_config(tmp_path / "a" / "config.yaml")
    assert loaded.config.units.length == unit
    near, far = loaded.config.filter.birth.depth_range  # type: ignore[union-attr,misc]
    assert 0.0 < near < far


def test_births_by_disparity_need_no_priors_of_a_calibration(scene: Path, tmp_path: Path) -> None:
    given = ["filter.birth.disparity={mean_px: 10.0, std_px: 5.0}", "filter.birth.depth_range=null"]
    written = init(tmp_path, None, scene / "cameras.yaml", given)["config"]
    assert "calibration:" not in Path(written).read_text()


def test_cameras_alone_and_a_log_alone(scene: Path, tmp_path: Path) -> None:
    init(tmp_path / "cameras", cameras_path=scene / "cameras.yaml", kind="animals")
    assert list(load_config(tmp_path / "cameras" / "config.yaml").cameras) == ["left", "right"]
    (tmp_path / "log.parquet").write_bytes((scene / "detections.parquet").read_bytes())
    init(tmp_path / "log", tmp_path / "log.parquet")
    assert "# The log has the cameras left (20 Hz), right (25 Hz)." in (tmp_path / "log" / "config.yaml").read_text()


def test_cameras_that_do_not_fit_leave_the_usual_values(
    scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    described = yaml.safe_load((scene / "cameras.yaml").read_text())
    for camera in described["cameras"].values():
        camera["pose"]["rotation_vector_deg"] = [-angle for angle in camera["pose"]["rotation_vector_deg"]]
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(described))
    with caplog.at_level(logging.WARNING, "stereophd"):
        report = init(tmp_path / "out", scene / "detections.parquet", tmp_path / "cameras.yaml")
    assert any(found["cause"] == "rotation_transposed" for found in report["checks"])
    assert (report["must_be_corrected"], report["must_be_calibrated"]) == (True, False)


@pytest.mark.parametrize("mistake", ["sign", "frame numbers"])
def test_a_mistake_that_is_named_is_corrected_before_anything_else(
    mistake: str, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The next command was `track`, with cameras that share no view, or with times that were named for a clock, too.

    What is said of all cameras is said once.
    """
    described, table = (
        yaml.safe_load((scene / "cameras.yaml").read_text()),
        pd.read_parquet(scene / "detections.parquet"),
    )
    for camera in described["cameras"].values():
        del camera["detector"]
        if mistake == "sign":
            camera["pose"]["rotation_vector_deg"][1] *= -1.0
    if mistake == "frame numbers":
        table["time_s"] = table["frame"].astype(float)
        table = table.sort_values(["time_s", "camera"], kind="stable")
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(described))
    table.to_parquet(tmp_path / "log.parquet", index=False)
    words = ["init", str(tmp_path / "study"), "--log", str(tmp_path / "log.parquet")]
    assert run(words) == 0
    printed = capsys.readouterr()
    assert printed.out.splitlines()[-1] == f"  {shlex.join(['stereophd', *words, '--force'])}"
    assert printed.out.count("detector: ") == 1
    assert f"{', '.join(described['cameras'])}: detector: " in printed.out
    named = re.findall(r"WARNING: check (\S+):", printed.err)
    assert named == (["geometry.cause"] if mistake == "sign" else ["log.frame_rate"] * 2)


def test_a_wrong_frame_rate_is_named_and_passes_for_no_noise(tmp_path: Path) -> None:
    """The rays of the camera miss by a hundred pixels: that was written as noise, and hid the cause."""
    scene = simulated(tmp_path / "scene", 6.0)
    table = pd.read_parquet(scene / "detections.parquet").drop(columns="object_id")
    late = table["camera"] == "right"
    table.loc[late, "time_s"] *= 2.0
    table.sort_values("time_s", kind="stable").to_parquet(tmp_path / "log.parquet", index=False)
    described = yaml.safe_load((scene / "cameras.yaml").read_text())
    for camera in described["cameras"].values():
        del camera["detector"], camera["frame_rate_hz"]
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(described))
    report = init(tmp_path / "out", tmp_path / "log.parquet", tmp_path / "cameras.yaml")
    assert [one["cause"] for one in report["checks"] if one["status"] == "warning"] == ["frame_rate"]
    for detector in report["detectors"].values():
        assert max(detector["sigma_px"]) < 2.0
        assert "times the rate of" in detector["source"]


def test_a_configuration_of_the_user_stays(scene: Path, tmp_path: Path) -> None:
    init(tmp_path, kind="lab")
    with pytest.raises(InputError, match=r"config\.yaml: expected no configuration, found one"):
        init(tmp_path, kind="lab")
    init(tmp_path, kind="drones", force=True)
    (tmp_path / "config.yaml").write_text("units: {length: m}\n")
    with pytest.raises(InputError, match="found another"):
        init(tmp_path, kind="lab", force=True)
    for options, message in (
        ({"kind": "planets"}, "`kind`: expected one of animals"),
        ({"length_unit": "mile"}, "`length_unit`: expected one of mm"),
        ({"length_unit": "cm", "cameras_path": scene / "cameras.yaml"}, r"units\.length: expected cm, found m"),
    ):
        with pytest.raises(InputError, match=message):
            init(tmp_path / "new", **options)


@pytest.mark.parametrize(
    ("motion", "model"),
    [({"model": "damped_velocity", "time_constant_s": 1.0}, "damped_velocity"),
     ({"model": "constant_velocity"}, "constant_velocity")],
)  # fmt: skip
def test_velocities_that_decay_are_told_from_those_that_last(
    motion: dict[str, Any], model: str, tmp_path: Path
) -> None:
    """The acceleration feeds the decaying ones up to their spread of 0.3 m/s; the others hardly change in 8 s."""
    values = yaml.safe_load((ROOT / "configs" / "quickstart.yaml").read_text())
    values["cameras"].pop("middle")
    decays = "time_constant_s" in motion
    noise = 0.3 * (2.0 / motion["time_constant_s"]) ** 0.5 if decays else 0.02
    values["simulate"] |= {"duration_s": 8.0, "motion": motion | {"acceleration_std": noise}}
    values["simulate"].pop("acceleration_std")
    values["simulate"]["objects"] |= {"births_per_s": 0.0}
    simulate(make_config(values), tmp_path / "scene")
    init(tmp_path / "study", tmp_path / "scene" / "detections.parquet")
    found = load_config(tmp_path / "study" / "config.yaml").config.motion
    assert found.model == model
    if decays:
        assert found.time_constant_s == pytest.approx(motion["time_constant_s"], rel=0.8)  # type: ignore[union-attr]


def test_a_motion_of_the_user_stays(scene: Path, tmp_path: Path) -> None:
    init(tmp_path, scene / "detections.parquet", overrides=["motion={model: static}"])
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["motion"] == {"model": "static"}


def test_only_track_estimates_an_acceleration(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="only track estimates it"):
        init(tmp_path / "study", scene / "detections.parquet", overrides=["motion.acceleration_std=estimate"])


def test_a_log_without_detections_is_refused(scene: Path, tmp_path: Path) -> None:
    """The acceleration was 15,000 m/s^2, "from the likelihood of 14 values over 500 events"."""
    log = pd.read_parquet(scene / "detections.parquet").drop_duplicates(["camera", "frame"])
    log[["u_px", "v_px"]] = np.nan
    log.to_parquet(tmp_path / "log.parquet", index=False)
    with pytest.raises(InputError, match=r"log\.parquet: expected detections, found none in \d+ frames of all cameras"):
        init(tmp_path / "study", tmp_path / "log.parquet", scene / "cameras.yaml")
    assert not (tmp_path / "study").exists()
