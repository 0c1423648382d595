"""`stereophd calibrate` from the files in to the files out: results, resume, bad input, scoring."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from stereophd.commands import calibrate as calibrating
from stereophd.commands.batches import calibrate_logs
from stereophd.commands.calibrate import calibrate as calibrate_on_all_cores
from stereophd.commands.evaluate_cameras import evaluate_calibration
from stereophd.commands.simulate import simulate
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.calibration.adjustment import marginal
from stereophd.errors import GateError, InputError
from stereophd.pipeline.calibration.problem import read_problem
from stereophd.pipeline.checks.finding import Finding
from stereophd.report.summaries import summary_text

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "paper" / "calibration.yaml"
THREE = CONFIG.parent.parent / "three_cameras_calibration.yaml"
# a shorter scene with less clutter, to be quick; two starts at most
QUICK = (
    "simulate.duration_s=30",
    "calibration.annealed.starts=2",
    *(f"cameras.{name}.detector.clutter_per_frame=3" for name in ("left", "right")),
)
# where a test is about something else than which start is right
ONE_START = ("calibration.annealed.starts=1", "calibration.annealed.agreeing_starts=1")

# Results do not depend on the number of processes (`again` has two), and to start some takes longer than these fits.
calibrate = partial(calibrate_on_all_cores, jobs=1)


def loaded(scene: Path, overrides: tuple[str, ...] = QUICK, config: Path = CONFIG) -> LoadedConfig:
    return load_config(config, overrides, cameras_path=scene / "guess.yaml")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrate") / "scene"
    simulate(load_config(CONFIG, QUICK), folder)
    return folder


@pytest.fixture(scope="module")
def result(scene: Path) -> Path:
    out = scene.parent / "result"
    calibrate(loaded(scene), scene / "detections.parquet", out, plots=False)
    return out


@pytest.fixture(scope="module")
def again(scene: Path) -> Path:
    """The same calibration on two processes, with plots, of few pairs, where there is a library for them."""
    out, can_draw = scene.parent / "again", find_spec("matplotlib") is not None
    with pytest.MonkeyPatch.context() as patch:
        if can_draw:
            patch.setattr("stereophd.report.plots.calibration_plots.MOST_PAIRS", 2)
        calibrate(loaded(scene), scene / "detections.parquet", out, jobs=2, plots=can_draw)
    return out


def test_cameras_are_found_to_the_bound_and_the_scale_is_left_to_the_prior(scene: Path, result: Path) -> None:
    report = json.loads((result / "report.json").read_text())
    assert report["status"] == "determined"
    assert report["scale"]["determined_by"] == "prior"
    assert report["scale"]["posterior_over_prior_std"] > 0.7
    assert report["fit"]["trajectories"] == 6
    # the guess is not checked, but the cameras that were found, and the tracks made with them
    assert {"geometry.rays", "tracking.explained"} <= {one["name"] for one in report["checks"]}
    assert not [one["message"] for one in report["checks"] if one["status"] == "warning"]
    truth = load_config(CONFIG, QUICK, cameras_path=scene / "cameras.yaml")
    scores = evaluate_calibration(result / "cameras.yaml", scene / "cameras.yaml", loaded=truth)
    errors, bounds = scores["cameras"]["right"], scores["bounds"]["cameras"]["right"]
    for key in ("rotation_deg", "direction_deg"):
        assert errors[key] < 5.0 * bounds[key]
        # what the posterior claims is what the bound allows
        claimed = report["cameras"]["right"][key.replace("_deg", "_std_deg")]
        assert 0.7 * bounds[key] < claimed < 2.0 * bounds[key]
    assert scores["posterior"]["nees"] < 1.0 + 5.0 * np.sqrt(2.0 / 6.0)
    # the motion of all cameras together does not count, their scale is a figure of its own
    assert errors["center_after_scale"] < errors["center"] + 1e-9


def test_outputs_are_those_of_track_and_depend_on_nothing_else(result: Path, again: Path) -> None:
    from stereophd.config.loading import load_cameras

    names = {path.name for path in result.iterdir()}
    expected = {
        "cameras.yaml",
        "posterior.parquet",
        "history.parquet",
        "tracks.parquet",
        "scans.parquet",
        "associations.parquet",
        "report.json",
    }
    assert names == expected
    assert list(load_cameras(result / "cameras.yaml").cameras) == ["left", "right"]
    posterior, history = pq.read_table(result / "posterior.parquet"), pq.read_table(result / "history.parquet")
    assert posterior.column_names[0] == "weight"
    assert posterior.column_names[1:] == history.column_names[1:-1]
    assert np.sum(posterior["weight"].to_numpy()) == pytest.approx(1.0)
    spread = history["right.rotation_y"].to_numpy()
    assert np.isfinite(spread).all()
    for name in sorted(names):
        assert (again / name).read_bytes() == (result / name).read_bytes(), name
    # beside them only plots: here, because another worker would calibrate once more for a test of its own
    plots = {f"{name}.{kind}" for name in ("history", "posterior", "residuals") for kind in ("png", "svg")}
    made = {path.name: path.stat().st_size for path in again.iterdir() if path.name not in names}
    assert made.keys() == (plots if find_spec("matplotlib") else set())
    assert all(size > 5000 for size in made.values())


# what each way needs beside QUICK, and the step after which it is interrupted
WAYS = {
    "annealed": (("calibration.method=annealed",), 1),
    "plain": (
        ("calibration.method=sequential", "calibration.sequential={moves: none, particles: 12, likelihood: phd}"),
        30,
    ),
    "sequential": (
        (
            "calibration.method=sequential",
            "calibration.sequential={particles: 8, first_particles: 8, moves_per_step: 1, inflation: [2]}",
        ),
        4,
    ),
    "smc": (
        (
            "calibration.posterior=smc",
            "calibration.smc={particles: 8, moves: 1}",
            *ONE_START,
            "calibration.scale={kind: baseline, cameras: [left, right], distance: 40, std: 0.5}",
        ),
        4,
    ),
    "smc of a lens and a clock": (
        (
            "calibration.posterior=smc",
            "calibration.smc={particles: 8, moves: 1}",
            "calibration.priors.right.focal_std=0.05",
            "calibration.priors.right.clock_offset_std_s=0.05",
            *ONE_START,
        ),
        4,
    ),
}


@pytest.mark.parametrize("method", WAYS)
def test_an_interrupted_run_continues_to_the_same_result(
    scene: Path, result: Path, tmp_path: Path, method: str
) -> None:
    chosen, stop_at = WAYS[method]
    overrides = (*QUICK, *chosen)
    log = scene / "detections.parquet"
    calls = 0

    def interrupt(done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if calls == stop_at:
            # what a signal may become in compiled code
            raise KeyboardInterrupt if method == "annealed" else SystemError

    with pytest.raises((KeyboardInterrupt, SystemError)):
        calibrate(loaded(scene, overrides), log, tmp_path / "out", plots=False, progress=interrupt)
    assert list((tmp_path / "out").glob("partial-*/*.saved"))
    assert not list((tmp_path / "out").glob("*.*"))
    calibrate(loaded(scene, overrides), log, tmp_path / "out", plots=False, resume=True, progress=lambda *_: None)
    # the default method is annealed
    whole = result if method == "annealed" else tmp_path / "whole"
    if method != "annealed":
        calibrate(loaded(scene, overrides), log, whole, plots=False)
    for path in sorted(whole.iterdir()):
        assert path.read_bytes() == (tmp_path / "out" / path.name).read_bytes(), path.name
    if method == "smc":
        report = json.loads((whole / "report.json").read_text())
        # the particles know of the distance too
        assert report["scale"]["posterior_over_prior_std"] < 0.3
        assert report["smc"]["ancestors"] > 1
    if method == "plain":
        # so few particles settle on wrong cameras, and do not get away with it
        report = json.loads((whole / "report.json").read_text())
        assert report["status"] == "undetermined"
        assert not (whole / "cameras.yaml").exists()


def kept_file(out: Path) -> Path:
    """Return the one file of an unfinished run."""
    (path,) = out.glob("partial-*/*.saved")
    return path


def test_resume_refuses_what_is_not_its_own(scene: Path, tmp_path: Path) -> None:
    log, out = scene / "detections.parquet", tmp_path / "out"
    foreign = out / "partial-0123456789abcdef" / "starts.saved"
    foreign.parent.mkdir(parents=True)
    foreign.write_bytes(b"mine")
    for words in ({"resume": True}, {"force": True}, {"resume": True, "force": True}):
        with pytest.raises(InputError, match="no part of an unfinished run; move it away"):
            calibrate(loaded(scene), log, out, **words)
    assert foreign.read_bytes() == b"mine"
    shutil.rmtree(out)

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    # without a checkpoint, a run that may resume begins at the start
    with pytest.raises(KeyboardInterrupt):
        calibrate(loaded(scene), log, out, resume=True, progress=stop)
    kept = kept_file(out).read_bytes()
    other = loaded(scene, (*QUICK, "seed=2"))
    with pytest.raises(InputError, match="an unfinished run of another configuration"):
        calibrate(other, log, out, resume=True)
    with pytest.raises(InputError, match="an unfinished run; use `resume=True`"):
        calibrate(loaded(scene), log, out)
    assert kept_file(out).read_bytes() == kept
    with pytest.raises(KeyboardInterrupt):
        calibrate(other, log, out, resume=True, force=True, progress=stop)
    assert kept_file(out).read_bytes() != kept
    # what an interrupted run has kept may be all that is wanted
    report = calibrate(other, log, out, resume=True, time_s=0.0, plots=False)
    assert report["status"] == "undetermined"
    assert "only 1 of 1 starts found these cameras" in report["reason"]
    # the answer is doubted: none of its values looks like a result
    assert not {"cameras", "parameters", "observability", "scale"} & set(report)
    assert "+- " not in summary_text(report)
    assert "calibration.time" in {one["name"] for one in report["checks"]}


def test_without_time_nothing_is_called_determined(scene: Path, tmp_path: Path) -> None:
    report = calibrate(loaded(scene), scene / "detections.parquet", tmp_path / "out", time_s=0.0, plots=False)
    assert report["status"] == "undetermined"
    assert "the time was over" in report["reason"]
    sampled = loaded(scene, (*QUICK, "calibration.posterior=smc"))
    with pytest.raises(InputError, match="`time_s`: expected method annealed"):
        calibrate(sampled, scene / "detections.parquet", tmp_path / "out", time_s=1.0, force=True)


def test_the_noise_of_the_residuals_is_that_of_cameras_and_tracks(scene: Path, tmp_path: Path) -> None:
    stated = yaml.safe_load((scene / "guess.yaml").read_text())
    for camera in stated["cameras"].values():
        camera["detector"]["sigma_px"] = [4.2, 4.2]
    (tmp_path / "guess.yaml").write_text(yaml.safe_dump(stated))
    report = calibrate(
        loaded(tmp_path, (*QUICK, *ONE_START)), scene / "detections.parquet", tmp_path / "out", plots=False
    )
    text = (tmp_path / "out" / "cameras.yaml").read_text()
    assert "# sigma_px is what the data show" in text
    for name, camera in yaml.safe_load(text)["cameras"].items():
        assert camera["detector"]["sigma_px"] == pytest.approx([4.2 * report["noise_factors"][name]] * 2)
        assert camera["detector"]["sigma_px"] == pytest.approx([2.0**0.5] * 2, rel=0.2)
    assert {one["status"] for one in report["checks"] if one["name"] == "tracking.noise"} == {"ok"}


@pytest.mark.parametrize(("stated", "found"), [(1.2, 1.2), (0.2, 2.0**0.5), (30.0, 30.0)])
def test_a_noise_far_below_that_of_one_camera_tracks_is_replaced(scene: Path, stated: float, found: float) -> None:
    overrides = [f"cameras.{name}.detector.sigma_px=[{stated}, {stated}]" for name in ("left", "right")]
    configuration = load_config(CONFIG, [*QUICK, *overrides], cameras_path=scene / "guess.yaml")
    problem = read_problem(configuration, scene / "detections.parquet")
    sigma = [float(camera.detector.sigma.mean()) for camera in problem.parameters.cameras]
    assert sigma == pytest.approx([found] * 2, rel=1e-9 if found == stated else 0.2)
    assert [remark.topic for remark in problem.remarks] == ([] if found == stated else ["noise"] * 2)
    assert problem.recording.sigma.mean() == pytest.approx(np.mean(sigma), rel=0.01)


def cut(scene: Path, out: Path, keep: Callable[[dict[str, np.ndarray]], np.ndarray]) -> Path:
    table = pq.read_table(scene / "detections.parquet")
    columns = {
        "camera": np.array(table["camera"].to_pylist()),
        "time_s": table["time_s"].to_numpy(),
        "object_id": table["object_id"].to_numpy(),
    }
    pq.write_table(table.filter(pa.array(keep(columns))), out)
    return out


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("calibration.priors={}",), "calibration.priors"),
        (("calibration.priors.right={center_std: 0, rotation_std_deg: 0}",), "expected a standard deviation above 0"),
        (("calibration.priors={rihgt: {center_std: 1, rotation_std_deg: 1}}",), "expected one of the cameras"),
        (("calibration.reference=middle",), "expected one of the cameras"),
        (("calibration=null",), "expected a section"),
        (
            ("calibration.scale={kind: baseline, cameras: [left, left], distance: 40, std: 1}",),
            "two cameras, found left twice",
        ),
        (("filter=null",), "filter: expected a filter section, found none"),
    ],
)
def test_configurations_that_cannot_be_calibrated(
    scene: Path, tmp_path: Path, overrides: tuple[str, ...], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        calibrate(loaded(scene, (*QUICK, *overrides)), scene / "detections.parquet", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_single_camera_cannot_be_calibrated(scene: Path, tmp_path: Path) -> None:
    whole = load_config(CONFIG, QUICK)
    left = json.dumps(whole.resolved["cameras"]["left"])
    one = load_config(CONFIG, [f"cameras={{left: {left}}}"])
    with pytest.raises(InputError, match="expected two or more"):
        calibrate(one, scene / "detections.parquet", tmp_path / "out")


def test_cameras_that_share_no_time(scene: Path, tmp_path: Path) -> None:
    log = cut(scene, tmp_path / "log.parquet", lambda c: (c["camera"] == "left") == (c["time_s"] < 25))
    with pytest.raises(InputError, match="overlap with another in time"):
        calibrate(loaded(scene), log, tmp_path / "out")
    log = cut(scene, tmp_path / "log.parquet", lambda c: c["camera"] == "left")
    with pytest.raises(InputError, match="expected detections of camera right, found none"):
        calibrate(loaded(scene), log, tmp_path / "out")


def test_clutter_alone_says_nothing(scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = cut(scene, tmp_path / "log.parquet", lambda c: c["object_id"] < 0)
    with pytest.raises(InputError, match="`require`: expected determined or partly, found all"):
        calibrate(loaded(scene), log, tmp_path / "out", plots=False, require="all")  # type: ignore[arg-type]
    with pytest.raises(GateError, match="the cameras are undetermined") as failure:
        calibrate(loaded(scene), log, tmp_path / "out", plots=False, require="partly")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert failure.value.report == report
    assert report["status"] == "undetermined"
    assert {found["name"].partition(".")[0] for found in report["checks"]} <= {
        "log",
        "detector",
        "camera",
        "calibration",
    }
    # the report, which is printed, has the reason: the error does not say it once more
    assert report["reason"] not in caplog.text + str(failure.value)
    assert "none of 2 starts" in report["reason"]
    assert "a pose that is far off needs wider priors, or `pose: unknown`" in report["reason"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"report.json"}


@pytest.mark.parametrize("method", ["annealed", "sequential"])
def test_an_acceleration_is_warned_of_where_none_was_estimated(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    warned = Finding("settings.acceleration_std", "warning", "it is too small")
    monkeypatch.setattr(calibrating, "check_log", lambda *_, alone=False, **__: () if alone else (warned,))
    monkeypatch.setattr(calibrating, "UNDETERMINED", "")  # so few particles determine nothing: tracks are made anyhow
    small = "calibration.sequential={moves: none, particles: 12, likelihood: phd}"
    given = loaded(scene, (*QUICK, *ONE_START, f"calibration.method={method}", small))
    report = calibrate(given, scene / "detections.parquet", tmp_path / "out", plots=False)
    assert report["tracking"]
    assert ("settings.acceleration_std" in {one["name"] for one in report["checks"]}) == (method == "sequential")


def test_an_optimum_that_was_not_found_is_not_determined(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(marginal, "LONGEST_LEFT", -1.0)
    report = calibrate(loaded(scene, (*QUICK, *ONE_START)), scene / "detections.parquet", tmp_path / "out", plots=False)
    assert report["status"] == "undetermined"
    assert report["reason"].startswith("the search for the optimum ended before it was found")
    assert not report["fit"]["converged"]


@pytest.mark.parametrize("model", ["constant_velocity", "static"])
def test_one_object_that_stands_still_leaves_the_cameras_undetermined(tmp_path: Path, model: str) -> None:
    given = "simulate.given=[{position: [0, 0, 150]}]"
    overrides = (*QUICK, *ONE_START, "simulate.objects=null", given, f"motion.model={model}")
    simulate(load_config(CONFIG, overrides), tmp_path / "scene")
    report = calibrate(
        loaded(tmp_path / "scene", overrides), tmp_path / "scene" / "detections.parquet", tmp_path / "out", plots=False
    )
    assert report["status"] == "undetermined"
    assert not (tmp_path / "out" / "cameras.yaml").exists()


@pytest.mark.parametrize(
    "scale",
    ["{kind: baseline, cameras: [left, right], distance: 40, std: 0.1}", "{kind: speed, speed: 1.5, std: 0.01}"],
)
def test_a_known_scale_is_kept(tmp_path: Path, scale: str) -> None:
    given = [
        {"position": [x, y, z], "velocity": velocity}
        for x, y, z, velocity in (
            (-20, 10, 130, [1.2, -0.9, 0.0]),
            (10, -15, 150, [-0.9, 0.0, 1.2]),
            (20, 15, 170, [-1.2, -0.9, 0.0]),
            (-10, -10, 200, [0.9, 0.0, -1.2]),
        )
    ]
    shown = ("simulate.duration_s=40", "simulate.objects=null", f"simulate.given={json.dumps(given)}")
    overrides = (*QUICK, *ONE_START, *shown)
    simulate(load_config(CONFIG, overrides), tmp_path / "scene")
    chosen = loaded(tmp_path / "scene", (*overrides, f"calibration.scale={scale}"))
    calibrate(chosen, tmp_path / "scene" / "detections.parquet", tmp_path / "out", plots=False)
    scores = evaluate_calibration(tmp_path / "out" / "cameras.yaml", tmp_path / "scene" / "cameras.yaml")
    # the distance of the objects, and so their speed, is known to about 1 %
    assert scores["joint"]["scale_ratio"] == pytest.approx(1.0, abs=0.03)


def test_a_known_length_between_two_objects_is_kept(tmp_path: Path) -> None:
    rod = [{"position": [x, 10, 130], "velocity": [0.9, -0.6, 0.3]} for x in (-25, -10)]
    other = {"position": [15, -15, 180], "velocity": [-1.2, 0.3, -0.6]}
    shown = ("simulate.duration_s=50", "simulate.objects=null", f"simulate.given={json.dumps([*rod, other])}")
    overrides = (*QUICK, *ONE_START, *shown)
    simulate(load_config(CONFIG, overrides), tmp_path / "scene")
    log, outcomes = tmp_path / "scene" / "detections.parquet", {}
    sampled = ("calibration.posterior=smc", "calibration.smc={particles: 8, moves: 1}")
    for name, length, more in (("18.0", 18.0, ()), ("30.0", 30.0, ()), ("smc", 18.0, sampled)):
        scale = f"calibration.scale={{kind: length, length: {length}, std: 0.1}}"
        chosen = loaded(tmp_path / "scene", (*overrides, scale, *more))
        outcomes[name] = calibrate(chosen, log, tmp_path / name, plots=False)
    # a fifth too long: everything is found a fifth too large
    scores = evaluate_calibration(tmp_path / "18.0" / "cameras.yaml", tmp_path / "scene" / "cameras.yaml")
    assert scores["joint"]["scale_ratio"] == pytest.approx(1.2, rel=0.03)
    assert outcomes["18.0"]["scale"]["determined_by"] == "length"
    # twice the true one does not go with the prior of the cameras
    assert outcomes["30.0"]["status"] == "undetermined"
    assert "standard deviations from the prior" in outcomes["30.0"]["reason"]
    # particles use the scale of the length, and no distance at single times
    assert [outcomes[name].get("known_lengths") for name in ("18.0", "smc")] == [1, None]


def test_more_clutter_than_stated_is_told_from_objects(scene: Path, tmp_path: Path) -> None:
    # a tenth of what there is: two thirds of the detections would be expected to be of objects, a third are
    overrides = (
        *QUICK, *ONE_START, *(f"cameras.{name}.detector.clutter_per_frame=0.3" for name in ("left", "right"))
    )  # fmt: skip
    log = scene / "detections.parquet"
    guess = (scene / "guess.yaml").read_text().replace("clutter_per_frame: 3.0", "clutter_per_frame: 0.3")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "guess.yaml").write_text(guess)
    report = calibrate(loaded(tmp_path / "scene", overrides), log, tmp_path / "out", plots=False)
    assert report["status"] == "determined"
    assert report["fit"]["explained"] == pytest.approx(1.0, abs=0.2)
    log = cut(scene, tmp_path / "log.parquet", lambda c: c["object_id"] < 0)
    report = calibrate(loaded(tmp_path / "scene", overrides), log, tmp_path / "clutter", plots=False)
    assert report["status"] == "undetermined"


def test_rolling_shutters_are_taken_into_account(tmp_path: Path) -> None:
    overrides = (
        "simulate.duration_s=10",
        "simulate.frame_rate_hz=5",
        "simulate.objects.velocity_std=8",
        "motion.max_speed=40",
        "filter.birth.velocity_std=8",
        *ONE_START,
        *(f"cameras.{name}.detector.clutter_per_frame=1" for name in ("left", "right")),
    )
    rolling = (*overrides, *(f"cameras.{n}.readout_s={s}" for n, s in (("left", 0.15), ("right", -0.15))))
    simulate(load_config(CONFIG, rolling), tmp_path / "scene")
    log, true = tmp_path / "scene" / "detections.parquet", tmp_path / "scene" / "cameras.yaml"
    report = calibrate(loaded(tmp_path / "scene", rolling), log, tmp_path / "out", plots=False)
    assert report["status"] == "determined"
    assert report["fit"]["rms_residual_sigmas"] == pytest.approx(1.0, abs=0.1)
    scores = evaluate_calibration(
        tmp_path / "out" / "cameras.yaml", true, loaded=load_config(CONFIG, rolling, cameras_path=true)
    )
    errors, bounds = scores["cameras"]["right"], scores["bounds"]["cameras"]["right"]
    for key in ("rotation_deg", "direction_deg"):
        assert errors[key] < 5.0 * bounds[key]
    guess = tmp_path / "scene" / "guess.yaml"
    lines = [line for line in guess.read_text().splitlines() if "readout_s" not in line]
    guess.write_text("\n".join(lines) + "\n")
    # what is stated need not be tested
    held = loaded(tmp_path / "scene", (*overrides, "calibration.model=as_stated"))
    ignored = calibrate(held, log, tmp_path / "ignored", plots=False)
    assert ignored["tracking"]["log_likelihood"] < report["tracking"]["log_likelihood"] - 10.0


def test_three_cameras_of_which_two_are_unknown(tmp_path: Path) -> None:
    quick = ("simulate.duration_s=25", *ONE_START)
    simulate(load_config(THREE, quick), tmp_path / "scene")
    report = calibrate(
        loaded(tmp_path / "scene", quick, THREE),
        tmp_path / "scene" / "detections.parquet",
        tmp_path / "out",
        plots=False,
    )
    assert report["status"] == "determined"
    truth = load_config(THREE, quick, cameras_path=tmp_path / "scene" / "cameras.yaml")
    scores = evaluate_calibration(tmp_path / "out" / "cameras.yaml", tmp_path / "scene" / "cameras.yaml", loaded=truth)
    for name in ("right", "above"):
        for key in ("rotation_deg", "direction_deg"):
            assert scores["cameras"][name][key] < 5.0 * scores["bounds"]["cameras"][name][key]


def test_cameras_of_one_file_alone_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    camera = "{image_size_px: [640, 480], intrinsics: {fx: 500, fy: 500, cx: 320, cy: 240}, pose: {center: [%d, 0, 0]}}"
    for name, count in (("estimate", 2), ("true", 3), ("one", 1)):
        lines = [f"  cam{k}: {camera % k}" for k in range(count)]
        (tmp_path / f"{name}.yaml").write_text("\n".join(["units: {length: m}", "cameras:", *lines]))
    for pair in (("estimate", "true"), ("true", "estimate")):
        caplog.clear()
        report = evaluate_calibration(*(tmp_path / f"{name}.yaml" for name in pair))
        assert list(report["cameras"]) == ["cam1"]
        assert "estimate.yaml has no cam2: not compared" in caplog.text
    with pytest.raises(InputError, match=r"one\.yaml: expected two or more cameras of .*, cam2\), found cam0"):
        evaluate_calibration(tmp_path / "one.yaml", tmp_path / "true.yaml")


def test_scoring_refuses_and_gates(scene: Path, result: Path, tmp_path: Path) -> None:
    estimate, true = result / "cameras.yaml", scene / "cameras.yaml"
    with pytest.raises(GateError, match=r"joint\.rotation_deg"):
        evaluate_calibration(estimate, true, fail_above={"joint.rotation_deg": 0.0})
    with pytest.raises(InputError, match=r"joint\.rotation: no such figure"):
        evaluate_calibration(estimate, true, fail_above={"joint.rotation": 1.0})
    with pytest.raises(InputError, match="reference: expected one of the cameras"):
        evaluate_calibration(estimate, true, reference="middle")
    # the bound is that of the true cameras, and the configuration has a third
    with pytest.raises(InputError, match=r"calibration\.priors\.above: expected one of the cameras left, right"):
        evaluate_calibration(estimate, true, loaded=load_config(THREE))
    report = evaluate_calibration(true, true, tmp_path / "out", reference="left")
    assert report["joint"]["rotation_deg"] == pytest.approx(0.0, abs=1e-6)
    assert report["joint"]["center"] == 0.0
    assert json.loads((tmp_path / "out" / "report.json").read_text())["provenance"]["command"] == "evaluate"


def test_all_cores_are_used_by_default(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from stereophd.cli.app import run

    words = ["calibrate", str(CONFIG), str(scene / "detections.parquet"), "--cameras", str(scene / "guess.yaml")]
    small = "calibration.sequential={moves: none, particles: 30, samples: 32, likelihood: phd}"
    words += ["--set", "calibration.method=sequential", "--set", small]
    run([*words, "--out", str(tmp_path / "out"), "--no-plots"])
    assert "internal error" not in capsys.readouterr().err
    one = calibrate(
        loaded(scene, ("calibration.method=sequential", small)),
        scene / "detections.parquet", tmp_path / "one", plots=False,
    )  # fmt: skip
    assert json.loads((tmp_path / "out" / "report.json").read_text())["status"] == one["status"]
    with pytest.raises(InputError, match="jobs"):
        calibrate(loaded(scene), scene / "detections.parquet", tmp_path / "none", jobs=0)
    with pytest.raises(InputError, match="jobs"):
        calibrate_logs(loaded(scene), [scene / "detections.parquet"] * 2, tmp_path / "none", jobs=0)
