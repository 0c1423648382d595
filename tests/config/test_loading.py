"""Configurations: order of what overrides what, and errors that name file, line, key and nearest key."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from stereophd.config.loading import LoadedConfig, json_schema, load_cameras, load_config
from stereophd.errors import InputError

CAMERA = {
    "image_size_px": [640, 480],
    "intrinsics": {"fx": 500.0, "fy": 500, "cx": 320, "cy": 240},
    "pose": {"center": [0, 0, 0]},
    "detector": {"sigma_px": [1, 1], "p_detect": 0.9, "clutter_per_frame": 1e1},
}

TEXT = """\
# a configuration
units: {length: cm}
seed: 3
cameras:
  zulu: &camera
    image_size_px: [640, 480]
    intrinsics: {fx: 500.0, fy: 500, cx: 320, cy: 240}
    pose:
      center: [0, 0, 0]
    detector: {sigma_px: [1, 1], p_detect: 0.9, clutter_per_frame: 1e1}
  alpha: *camera
filter:
  prune_weight: 1e-7
  birth:
    velocity_std: 2
    depth_range: [10, 100]
  kind: phd
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "config.yaml").write_text(TEXT)
    return tmp_path / "config.yaml"


def message(path: Path, *overrides: str, **options: Any) -> str:
    with pytest.raises(InputError) as caught:
        load_config(path, overrides, **options)
    return str(caught.value)


def replaced(path: Path, old: str, new: str) -> str:
    """Return the error of the configuration with one text replaced."""
    assert TEXT.count(old) == 1
    path.write_text(TEXT.replace(old, new))
    return message(path)


class TestValues:
    def test_defaults_file_set_and_seed_in_this_order(self, path: Path) -> None:
        loaded = load_config(path)
        assert loaded.config.filter is not None
        assert loaded.config.filter.merge_distance == 7.0
        assert loaded.config.filter.prune_weight == 1e-7
        assert loaded.config.seed == 3
        loaded = load_config(path, ["filter.prune_weight=1e-3", "seed=5", "filter.prune_weight=1e-4"], seed=6)
        assert loaded.config.filter is not None
        assert loaded.config.filter.prune_weight == 1e-4
        assert loaded.config.seed == 6

    def test_of_a_folder(self, path: Path) -> None:
        path.rename(path.with_name("config.yaml"))
        assert load_config(path.parent).path == path.with_name("config.yaml")

    def test_cameras_keep_their_order(self, path: Path) -> None:
        loaded = load_config(path)
        assert list(loaded.cameras) == ["zulu", "alpha"]
        assert list(loaded.resolved["cameras"]) == ["zulu", "alpha"]
        assert [camera.name for camera in loaded.build_cameras()] == ["zulu", "alpha"]

    def test_resolved_is_json_and_loads_to_the_same(self, path: Path, tmp_path: Path) -> None:
        loaded = load_config(path, ["motion.acceleration_std=[1, 2, 3]"])
        copy = tmp_path / "copy.yaml"
        copy.write_text(yaml.safe_dump(json.loads(json.dumps(loaded.resolved)), sort_keys=False))
        again = load_config(copy)
        assert again.resolved == loaded.resolved
        assert again.sha256 == loaded.sha256
        assert again.config == loaded.config

    def test_hash_depends_on_values_and_on_the_order_of_cameras_only(self, path: Path, tmp_path: Path) -> None:
        data = yaml.safe_load(TEXT)
        data["filter"]["prune_weight"] = 1e-7
        data["cameras"]["zulu"]["detector"]["clutter_per_frame"] = 10

        def digest(values: dict[str, Any], *overrides: str) -> str:
            other = tmp_path / "other.yaml"
            other.write_text(json.dumps(values))
            return load_config(other, overrides).sha256

        assert digest(dict(reversed(data.items()))) == load_config(path).sha256
        assert digest(data, "seed=4") != load_config(path).sha256
        cameras = dict(reversed(data["cameras"].items()))
        assert digest({**data, "cameras": cameras}) != load_config(path).sha256

    def test_overrides_reach_into_lists_and_new_sections(self, path: Path) -> None:
        loaded = load_config(path, ["cameras.alpha.pose.center.2=4.5", "input.on_bad_row=drop", "filter=null"])
        assert loaded.cameras["alpha"].pose.center == (0, 0, 4.5)
        assert loaded.cameras["zulu"].pose.center == (0, 0, 0)
        assert loaded.config.input.on_bad_row == "drop"
        assert loaded.config.filter is None

    def test_merge_keys(self, path: Path) -> None:
        path.write_text(TEXT.replace("alpha: *camera", "alpha:\n    <<: *camera\n    image_size_px: [320, 240]"))
        cameras = load_config(path).cameras
        assert cameras["alpha"].image_size_px == (320, 240)
        assert cameras["alpha"].intrinsics == cameras["zulu"].intrinsics

    def test_a_camera_may_be_named_by_a_number(self, path: Path) -> None:
        path.write_text(TEXT.replace("zulu:", "0:"))
        loaded = load_config(path, ["cameras.0.image_size_px.0=800"])
        assert loaded.cameras["0"].image_size_px == (800, 480)


class TestCameras:
    @pytest.fixture
    def cameras(self, tmp_path: Path) -> Path:
        folder = tmp_path / "cameras"
        folder.mkdir()
        (folder / "pair.yaml").write_text(yaml.safe_dump({"units": {"length": "cm"}, "cameras": {"left": CAMERA}}))
        return folder / "pair.yaml"

    def with_path(self, path: Path, text: str) -> LoadedConfig:
        start, end = TEXT.index("cameras:"), TEXT.index("filter:")
        path.write_text(TEXT[:start] + f"cameras: {text}\n" + TEXT[end:])
        return load_config(path)

    def test_of_a_file_beside_the_configuration(
        self, path: Path, cameras: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        (tmp_path / "elsewhere").mkdir()
        monkeypatch.chdir(tmp_path / "elsewhere")
        loaded = self.with_path(path, "cameras/pair.yaml")
        assert list(loaded.cameras) == ["left"]
        assert loaded.resolved["cameras"]["left"]["intrinsics"]["fx"] == 500.0
        assert set(loaded.inputs) == {"config", "cameras"}

    def test_of_the_command_line_replace_the_configurations(self, path: Path, cameras: Path) -> None:
        loaded = load_config(path, ["cameras.left.detector.p_detect=0.5"], cameras_path=cameras)
        assert list(loaded.cameras) == ["left"]
        assert loaded.cameras["left"].detector.p_detect == 0.5

    def test_without_detectors_keep_those_of_the_configuration(
        self, path: Path, cameras: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        """`init` had estimated 0.6 px, and a guess of poses, without detectors, made them the usual 3 px."""
        bare = {key: value for key, value in CAMERA.items() if key != "detector"}
        cameras.write_text(yaml.safe_dump({"units": {"length": "cm"}, "cameras": {"zulu": bare, "new": bare}}))
        loaded = load_config(path, cameras_path=cameras)
        assert loaded.cameras["zulu"].detector == load_config(path).cameras["zulu"].detector
        assert loaded.cameras["new"].detector.estimate
        assert not caplog.messages
        text = path.read_text().replace("p_detect: 0.9", "p_detect: 1.9", 1)
        assert text != path.read_text()
        path.write_text(text)
        assert "cameras.zulu.detector.p_detect: expected a number <= 1, found 1.9" in message(
            path, cameras_path=cameras
        )

    def test_of_the_command_line_spare_a_file_that_is_not_there(self, path: Path, cameras: Path) -> None:
        with pytest.raises(InputError, match=r"nothing\.yaml: there is no such file"):
            self.with_path(path, "nothing.yaml")
        assert list(load_config(path, cameras_path=cameras).cameras) == ["left"]

    def test_in_another_unit_are_refused(self, path: Path, cameras: Path) -> None:
        found = message(path, "units.length=m", cameras_path=cameras)
        assert found == f"{cameras}: units.length: expected m as in {path}, found cm"

    def test_without_a_unit_are_refused(self, path: Path, cameras: Path) -> None:
        cameras.write_text(yaml.safe_dump({"cameras": {"left": CAMERA}}))
        assert message(path, cameras_path=cameras) == f"{cameras}:1: units: expected this key, found none"

    def test_a_fault_names_their_file(self, path: Path, cameras: Path) -> None:
        cameras.write_text(cameras.read_text().replace("p_detect: 0.9", "p_detect: 1.9"))
        line = cameras.read_text().splitlines().index("      p_detect: 1.9") + 1
        expected = f"{cameras}:{line}: cameras.left.detector.p_detect: expected a number <= 1, found 1.9"
        assert message(path, cameras_path=cameras) == expected

    def test_twice_on_the_command_line_are_refused(self, path: Path, cameras: Path) -> None:
        assert "found both" in message(path, f"cameras={cameras}", cameras_path=cameras)

    def test_a_key_whose_place_another_takes(self, cameras: Path) -> None:
        camera = CAMERA | {"intrinsics": {"focal": "unknown", "fx": 500}}
        cameras.write_text(yaml.safe_dump({"units": {"length": "cm"}, "cameras": {"left": camera}}))
        with pytest.raises(InputError, match=r"intrinsics\.fx: expected no fx beside focal, which takes its place"):
            load_cameras(cameras)

    def test_a_toml_file_that_is_none_is_told_so(self, tmp_path: Path) -> None:
        path = tmp_path / "calibration.toml"
        path.write_text('[cam_0]\nname = "a\n')
        with pytest.raises(InputError, match=rf"^{re.escape(str(path))}: expected TOML, found: .*\(at line 2, column"):
            load_cameras(path)

    def test_load_cameras(self, cameras: Path) -> None:
        assert load_cameras(cameras).units.length == "cm"

    def test_none_at_all(self, path: Path) -> None:
        with pytest.raises(InputError, match="expected cameras"):
            load_config(path, ["cameras=null"]).build_cameras()


class TestErrors:
    def test_no_such_file(self, tmp_path: Path) -> None:
        assert message(tmp_path / "a.yaml") == f"{tmp_path / 'a.yaml'}: there is no such file"

    def test_a_folder(self, tmp_path: Path) -> None:
        assert message(tmp_path) == f"{tmp_path / 'config.yaml'}: there is no such file"

    @pytest.mark.parametrize(
        ("old", "new", "line", "expected"),
        [
            (
                "prune_weight",
                "prune_wieght",
                13,
                "filter.prune_wieght: unknown key; did you mean prune_weight?",
            ),
            (
                "prune_weight",
                "exchange_above",
                13,
                "filter.exchange_above: belongs to filter.kind pmb, found phd",
            ),
            ("filter:", "fitler:", 12, "fitler: unknown key; did you mean filter?"),
            (
                "velocity_std",
                "velocity_sdt",
                15,
                "filter.birth.velocity_sdt: unknown key; did you mean velocity_std?",
            ),
            ("seed: 3", "seed: -3", 3, "seed: expected a number >= 0, found -3"),
            ("seed: 3", "seed: 3.5", 3, "seed: expected an integer, found 3.5"),
            ("seed: 3", "seed: '3'", 3, 'seed: expected an integer, found "3"'),
            ("seed: 3", "seed: true", 3, "seed: expected an integer, found true"),
            (
                "velocity_std: 2",
                "velocity_std: -2",
                15,
                "filter.birth.velocity_std: expected a number > 0, found -2",
            ),
            (
                "velocity_std: 2",
                "velocity_std: yes",
                15,
                'filter.birth.velocity_std: expected a number, found "yes"',
            ),
            (
                "velocity_std: 2",
                "velocity_std: .inf",
                15,
                "filter.birth.velocity_std: expected a number <= 1e+15, found Infinity",
            ),
            ("[10, 100]", "[10]", 16, "filter.birth.depth_range.1: expected more values, found [10]"),
            ("[10, 100]", "[10, 20, 30]", 16, "filter.birth.depth_range: expected at most 2 values, found 3"),
            (
                "[10, 100]",
                "[20, 10]",
                14,
                "filter.birth: depth_range: expected near < far, found [20.0, 10.0]",
            ),
            ("    velocity_std: 2\n", "", 14, "filter.birth.velocity_std: expected this key, found none"),
            (
                "length: cm",
                "length: ell",
                2,
                """units.length: expected 'mm', 'cm', 'm', 'km' or 'baseline', found "ell\"""",
            ),
            ("units: {length: cm}", "units: cm", 2, 'units: expected a mapping, found "cm"'),
            (
                "image_size_px: [640, 480]",
                "image_size_px: [640, -480]",
                6,
                "cameras.zulu.image_size_px.1: expected a number >= 1, found -480",
            ),
            (
                "sigma_px: [1, 1]",
                "sigma_px: [-1, 1]",
                10,
                "cameras.zulu.detector.sigma_px.0: expected a number > 0, found -1",
            ),
        ],
    )
    def test_names_line_key_and_what_was_found(self, path: Path, old: str, new: str, line: int, expected: str) -> None:
        found = replaced(path, old, new).splitlines()
        assert found[0] == f"{path}:{line}: {expected}"
        # The alias repeats the fault of the camera; nothing else has a second one.
        assert len(found) == (2 if "zulu" in expected else 1)

    def test_a_matrix_that_is_not_a_rotation(self, path: Path) -> None:
        found = replaced(
            path,
            "      center: [0, 0, 0]\n",
            "      center: [0, 0, 0]\n      rotation_matrix: [[1, 0, 0], [0, 1, 0], [0, 0, -1]]\n",
        ).splitlines()[0]
        assert found.startswith(f"{path}:10: cameras.zulu.pose.rotation_matrix: expected a rotation matrix")
        assert "determinant -1" in found

    def test_the_branch_of_a_union_is_not_a_key(self, path: Path) -> None:
        found = message(path, "motion.acceleration_std=fast")
        assert found == (
            "`overrides` motion.acceleration_std=fast: motion.acceleration_std: "
            "expected a number or a list or 'estimate', found \"fast\""
        )

    def test_known_keys_of_a_lens_are_those_of_its_model(self, path: Path) -> None:
        found = message(path, "cameras.alpha.distortion={model: radial, k9: 1, k1: 0}")
        assert found.endswith("cameras.alpha.distortion.k9: unknown key; expected one of model, k1")
        found = message(path, "cameras.alpha.distortion={model: fisheye, tilt: 1}")
        assert found.endswith("unknown key; expected one of model, k1, k2, k3, k4")

    def test_an_unknown_lens(self, path: Path) -> None:
        found = message(path, "cameras.alpha.distortion={model: pinhole}")
        assert "cameras.alpha.distortion.model: expected one of none, radial, brown_conrady, fisheye" in found

    def test_all_faults_are_listed_in_order_of_lines(self, path: Path) -> None:
        path.write_text(TEXT.replace("seed: 3", "seed: x").replace("prune_weight", "prune"))
        lines = message(path).splitlines()
        assert [line.split(": ")[0] for line in lines] == [f"{path}:3", f"{path}:13"]

    @pytest.mark.parametrize(
        ("override", "expected"),
        [
            ("filter.prune_wieght=1", "filter.prune_wieght: unknown key; did you mean prune_weight?"),
            ("fitler.kind=phd", "fitler: unknown key; did you mean filter?"),
            ("filter.prune_weight=-1", "filter.prune_weight: expected a number > 0, found -1"),
            # the beginning of one key; of several; a key of another place; of two; a camera that is not there
            ("filter.bi=1", "filter.bi: unknown key; did you mean birth?"),
            ("filter.m=1", "filter.m: unknown key; expected one of kind, "),
            ("birth.per_s=1", "birth: unknown key; did you mean filter.birth?"),
            ("max_speed=1", "max_speed: unknown key; did you mean seed or motion.max_speed or simulate.motion.max_"),
            ("samples=1", "samples: unknown key; did you mean moments.samples or calibration.sequential.samples?"),
            (
                "detector.sigma_px=1",
                "detector: expected 'given' or 'estimate', found {\"sigma_px\": 1}; did you mean "
                "cameras.NAME.detector.sigma_px?",
            ),
            ("detector.x=1", "detector: expected 'given' or 'estimate', found {\"x\": 1}"),
            (
                "cameras.alhpa.detector.p_detect=0.5",
                "cameras.alhpa.detector.p_detect: expected one of the cameras zulu, alpha, found alhpa; did you mean "
                "alpha?",
            ),
            ("seed.x=1", "seed.x: expected the path of a key, found no mapping or list that has x"),
            ("cameras.alpha.pose.center.3=1", "cameras.alpha.pose.center.3: expected the path of a key"),
        ],
    )
    def test_of_an_override_names_the_override(self, path: Path, override: str, expected: str) -> None:
        found = message(path, override)
        assert found.startswith(f"`overrides` {override}: {expected}")
        assert len(found.splitlines()) == 1

    @pytest.mark.parametrize("override", ["seed", "=3", "filter..birth=3"])
    def test_of_an_override_that_is_none(self, path: Path, override: str) -> None:
        assert message(path, override) == f"`overrides` {override}: expected KEY.PATH=VALUE"

    def test_of_the_seed_names_the_option(self, path: Path) -> None:
        assert message(path, seed=-1) == "`seed`: seed: expected a number >= 0, found -1"

    @pytest.mark.parametrize(
        ("text", "line", "expected"),
        [
            ("", 1, "expected a mapping of keys to values, found an empty file"),
            ("- 1", 1, "expected a mapping of keys to values, found a list"),
            ("seed: 1\nseed: 2", 2, "seed: expected each key once, found it again (first at line 1)"),
            ("a: 1\nunits: [1", 2, "expected YAML, found a syntax error"),
            ("seed: 1\n---\nseed: 2", 2, "expected YAML, found a syntax error"),
            ("seed: !!python/object:os.system 1", 1, "expected plain YAML values, found the tag"),
            ("? [1]\n: 2", 1, "expected a plain key"),
            ("a: &a [*a]", 1, "expected a finite document"),
        ],
    )
    def test_of_what_is_no_configuration(self, path: Path, text: str, line: int, expected: str) -> None:
        path.write_text(text)
        assert message(path).startswith(f"{path}:{line}: {expected}")

    def test_of_what_is_no_text(self, path: Path) -> None:
        path.write_bytes(b"seed: \xff\xfe\x00")
        assert message(path).startswith(f"{path}: expected YAML text")

    def test_of_aliases_that_explode(self, path: Path) -> None:
        levels = [f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 10)}]" for i in range(1, 9)]
        path.write_text("\n".join(["l0: &l0 [1]", *levels]))
        assert "aliases that expand without end" in message(path)

    def test_of_endless_nesting(self, path: Path) -> None:
        path.write_text("[\n" * 5000)
        assert "nested too deeply" in message(path)


def test_schema_forbids_unknown_keys_everywhere() -> None:
    schema = json_schema()
    objects = [schema, *schema["$defs"].values()]
    assert all(node["additionalProperties"] is False for node in objects if "properties" in node)


@pytest.mark.parametrize("samples", [16, 32, 96])
def test_qmc_samples_are_a_power_of_two_that_carries_a_covariance(path: Path, samples: int) -> None:
    assert message(path, f"moments.samples={samples}").endswith(
        f"moments: samples: expected a power of two of at least 64 for method qmc, found {samples}"
    )
    other = load_config(path, [f"moments.samples={samples}", "moments.method=particle"])
    assert other.config.moments.samples == samples


def test_a_mean_disparity_is_positive(path: Path) -> None:
    prior = "filter.birth={velocity_std: 1, disparity: {mean_px: 0.0, std_px: 1.0}}"
    assert "filter.birth.disparity.mean_px: expected a number > 0, found 0" in message(path, prior)


def test_a_misspelt_kind_is_named_where_it_stands(tmp_path: Path) -> None:
    quickstart = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"
    with pytest.raises(
        InputError, match=r'^`overrides` filter.kind=pbm: filter.kind: expected .*, found "pbm"; did you mean pmb'
    ):
        load_config(quickstart, ["filter.kind=pbm"])


def test_infinity_is_recorded_as_yaml_writes_it(path: Path) -> None:
    """JSON has no number for it."""
    loaded = load_config(path, ["filter.out_of_view_s=.inf"])
    assert loaded.resolved["filter"]["out_of_view_s"] == "inf"
    json.dumps(loaded.resolved, allow_nan=False)
