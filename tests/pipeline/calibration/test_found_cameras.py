"""Cameras whose poses and clocks are unknown in the configuration: found, calibrated, and stated in an honest unit."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.calibration.discovery.rig import FoundRig, Spread
from stereophd.core.calibration.time_limit import TimeLimit
from stereophd.errors import InputError
from stereophd.pipeline.calibration import found_cameras
from stereophd.pipeline.calibration.found_cameras import FoundCameras, with_found_cameras

PAPER = Path(__file__).parents[3] / "configs" / "paper" / "calibration.yaml"


def unknown_cameras(folder: Path, **changes: object) -> Path:
    """The cameras of the paper without poses."""
    cameras = yaml.safe_load(PAPER.read_text())["cameras"]
    for camera in cameras.values():
        camera["pose"] = "unknown"
        camera.update(changes)
    path = folder / "cameras.yaml"
    path.write_text(yaml.safe_dump({"units": {"length": "cm"}, "cameras": cameras}))
    return path


def stated(folder: Path, *overrides: str, **changes: object) -> LoadedConfig:
    return load_config(PAPER, ("calibration.priors={}", *overrides), None, unknown_cameras(folder, **changes))


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from stereophd.commands.simulate import simulate

    folder = tmp_path_factory.mktemp("scene") / "out"
    simulate(load_config(PAPER), folder)
    return folder / "detections.parquet"


def test_what_is_known_stays_as_it_is() -> None:
    loaded = load_config(PAPER)
    assert with_found_cameras(loaded, "no log is read") == (loaded, None)


def test_logs_of_unknown_clocks_that_show_nothing_are_undetermined(tmp_path: Path, log: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from stereophd.commands.calibrate import calibrate

    # a few frames, and the clock of the second camera is 1000 s off: by their clocks the logs share no time
    table = pq.read_table(log).to_pandas()
    table = table[table["time_s"] < 4.0]
    table.loc[table["camera"] == "right", "time_s"] += 1000.0
    pq.write_table(pa.Table.from_pandas(table, preserve_index=False), tmp_path / "log.parquet")
    path = unknown_cameras(tmp_path)
    tree = yaml.safe_load(path.read_text())
    tree["cameras"]["right"]["clock"] = {"offset_s": "unknown"}
    path.write_text(yaml.safe_dump(tree))
    loaded = load_config(PAPER, ("calibration.priors={}",), None, path)
    report = calibrate(loaded, tmp_path / "log.parquet", tmp_path / "out", plots=False, jobs=1)
    assert report["status"] == "undetermined"
    assert "no object can be followed" in report["reason"]


@pytest.mark.parametrize("empty", ["left", "right"])
def test_an_empty_camera_is_refused_by_its_name(tmp_path: Path, log: Path, empty: str) -> None:
    """The remedy was to record fewer false detections with it; `left` is the reference."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from stereophd.commands.calibrate import calibrate

    table = pq.read_table(log).to_pandas()
    table.loc[table["camera"] == empty, ["u_px", "v_px"]] = None
    table = table[(table["camera"] != empty) | ~table.duplicated(["camera", "frame"])]
    pq.write_table(pa.Table.from_pandas(table, preserve_index=False), tmp_path / "log.parquet")
    loaded = load_config(PAPER, ("calibration.priors={}",), None, unknown_cameras(tmp_path))
    with pytest.raises(InputError, match=f"expected detections of camera {empty}, found none"):
        calibrate(loaded, tmp_path / "log.parquet", tmp_path / "out", plots=False, jobs=1)
    assert not (tmp_path / "out").exists()


def test_an_unknown_pose_is_refused_where_one_is_needed(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"cameras\.left\.pose: expected a value, found unknown: run `calibrate` first"
    ):
        stated(tmp_path).build_cameras()


def test_unknown_values_survive_the_record(tmp_path: Path) -> None:
    loaded = stated(tmp_path, intrinsics={"focal": "unknown"}, clock={"offset_s": "unknown"})
    camera = loaded.cameras["right"]
    assert camera.pose.unknown
    assert camera.clock.unknown
    assert camera.intrinsics.unknown
    assert type(camera).model_validate(camera.model_dump()) == camera


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("calibration.priors.right={center_std: 1.0}", "priors.right.center_std: expected none of an unknown camera"),
        ("calibration.scale={kind: speed, speed: 1.0, std: 0.1}", "scale.kind: expected none or baseline"),
        ("cameras.right.pose={center: [40, 0, 0]}", "cameras.right.pose: expected unknown as that of left"),
        ("cameras.left.clock={offset_s: unknown}", "reference: expected a camera whose clock is taken as true"),
    ],
)
def test_contradictions_are_refused(tmp_path: Path, override: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        with_found_cameras(stated(tmp_path, override), "no log is read")


def test_cameras_are_found_in_the_unit_of_their_distance(tmp_path: Path, log: Path) -> None:
    # the frames of the adjustment are too few for tracks of sixteen detections
    loaded, found = with_found_cameras(stated(tmp_path, "calibration.annealed.max_events=20"), log)
    assert found is not None
    assert not found.reason
    assert loaded.config.units.length == "baseline"
    left, right = loaded.build_cameras()
    assert np.linalg.norm(right.pose.center - left.pose.center) == pytest.approx(1.0)
    # true: 30 degrees
    angle = np.degrees(np.arccos(0.5 * (np.trace(right.pose.rotation) - 1.0)))
    assert angle == pytest.approx(30.0, abs=3.0)
    assert loaded.config.calibration is not None
    # what is stated of the images is not exact either
    assert set(loaded.config.calibration.priors) == {"left", "right"}
    # the settings follow: objects lie somewhat beyond the depth that the births expect, the cameras 40 cm apart
    assert 6.0 / 40.0 < loaded.config.motion.max_speed < 2.0 * 6.0 / 40.0


def test_settings_that_the_tracks_contradict_yield_where_no_length_is_known(tmp_path: Path, log: Path) -> None:
    """Metres guessed for a scene of another size made calibrations four times slower, with five times the tracks."""
    few = "calibration.annealed.max_events=20"
    _, found = with_found_cameras(stated(tmp_path, few), log)
    assert found is not None
    of_depths = {"report.max_position_std"}
    assert set(found.report()["estimated_settings"]) == of_depths
    wrong = stated(tmp_path, few, "filter.birth.velocity_std=12", "motion.max_speed=60", "motion.acceleration_std=1")
    loaded, found = with_found_cameras(wrong, log)
    assert found is not None
    contradicted = {"filter.birth.velocity_std", "motion.acceleration_std"}
    assert set(found.report()["estimated_settings"]) == of_depths | contradicted
    assert loaded.config.filter is not None
    # true: 0.0117 baselines per second and axis, times 1.5, and objects that hardly accelerate
    assert 0.01 < np.max(loaded.config.filter.birth.velocity_std) < 0.1
    assert np.max(loaded.config.motion.acceleration_std) < 1e-3


def test_settings_are_left_where_the_time_is_over(tmp_path: Path, log: Path) -> None:
    """The filter ran for each acceleration that was tried, however little time was left (`--time`)."""

    class Short(TimeLimit):
        def begin(self, stage: str) -> bool:
            return stage != "settings are compared with what the tracks show"

    wrong = stated(tmp_path, "calibration.annealed.max_events=20", "filter.birth.velocity_std=12")
    _, found = with_found_cameras(wrong, log, Short())
    assert found is not None
    assert not found.reason
    assert not {"filter.birth.velocity_std", "motion.acceleration_std"} & set(found.estimated)


def test_a_known_distance_gives_the_scale(tmp_path: Path, log: Path) -> None:
    scale = "calibration.scale={kind: baseline, cameras: [left, right], distance: 40.0, std: 0.1}"
    loaded, found = with_found_cameras(stated(tmp_path, scale), log)
    assert found is not None
    assert found.has_scale
    left, right = loaded.build_cameras()
    assert loaded.config.units.length == "cm"
    assert np.linalg.norm(right.pose.center - left.pose.center) == pytest.approx(40.0)


@pytest.mark.parametrize("intrinsics", [{}, {"intrinsics": {"focal": "unknown"}}])
def test_images_are_known_no_better_than_stated(tmp_path: Path, intrinsics: dict[str, object]) -> None:
    """Four cameras of a drone whose stated principal points were taken as exact were undetermined."""
    right = "calibration.priors.right={principal_point_std_px: 3.0, focal_std: 0.0}"
    loaded = stated(tmp_path, right, **intrinsics)
    section = found_cameras.refuse_search(loaded)
    cameras = tuple(config.build(name) for name, config in loaded.cameras.items())
    views = [found_cameras._view(loaded, section, camera) for camera in cameras]
    rig = FoundRig(cameras, (Spread(0.01, 0.01, 0.0, 0.002),) * 2, (), ())
    priors = found_cameras._priors(loaded, section, views, rig, {})
    assert priors["left"]["principal_point_std_px"] == pytest.approx(0.01 * cameras[0].width)
    assert priors["right"]["principal_point_std_px"] == 3.0
    assert priors["left"]["focal_std"] == pytest.approx(0.01)
    assert priors["right"]["focal_std"] == 0.0
    assert views[1].focal_std == 0.0


def test_unknowns_that_were_freed_are_judged_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock is judged by the frames of the slower of two cameras: one of 50 Hz beside 25 Hz needs no more."""
    monkeypatch.setattr(found_cameras, "posed_cameras", lambda _: ())
    found = FoundCameras(("right",), None, "", has_scale=True, intervals={"left": 0.04, "right": 0.02})
    problem = SimpleNamespace(parameters=SimpleNamespace(names=("right.clock_offset",)), reference=0)
    left = SimpleNamespace(name="left", pose=SimpleNamespace(center=np.zeros(3)))
    freed = SimpleNamespace(names=("right.clock_offset", "right.focal"), build=lambda _: (left,))

    def left_open(clock: float, focal: float) -> list[str]:
        outcome = SimpleNamespace(parameters=freed, values=np.zeros(2), covariance=np.diag([clock, focal]) ** 2)
        return found._left_open(problem, outcome)

    assert left_open(0.03, 0.1) == ["the focal length of right is known to 10 %"]
    assert left_open(0.05, 0.01) == ["the clock of right is known to 0.05 s"]


def test_the_place_of_a_camera_counts_beside_the_size_of_the_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    """The direction of a camera next to the reference is hard to know, and moves no track by much."""
    monkeypatch.setattr(found_cameras, "posed_cameras", lambda _: ("near",))
    spread = SimpleNamespace(rotation=0.002, direction=0.06)
    monkeypatch.setattr(found_cameras, "pose_spread", lambda *_: spread)
    found = FoundCameras(("near",), None, "", has_scale=True, intervals={"near": 0.1})

    def left_open(far: float) -> list[str]:
        places = {"reference": 0.0, "near": 1.0, "far": far}
        cameras = [
            SimpleNamespace(name=name, pose=SimpleNamespace(center=np.array([x, 0.0, 0.0])))
            for name, x in places.items()
        ]
        parameters = SimpleNamespace(names=(), build=lambda _: cameras)
        outcome = SimpleNamespace(parameters=parameters, values=np.zeros(0), covariance=np.zeros((0, 0)))
        return found._left_open(SimpleNamespace(parameters=parameters, reference=0), outcome)

    assert left_open(far=5.0) == []
    assert left_open(far=1.0) == ["near is known to 0.1 degrees in rotation and 3.4 in direction"]
