"""Load a configuration: defaults < file < overrides < seed, with errors that name the place."""

import copy
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from stereophd.config.errors import describe
from stereophd.config.model import Config
from stereophd.config.report import CameraTimes
from stereophd.config.yaml import Place, Tree, apply_override, key_path, parse_override, read_yaml
from stereophd.core.bodies.shapes.point import PointSettings
from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError, unknown_camera
from stereophd.io.cameras.models import CameraConfig, CamerasFile
from stereophd.io.interchange.options import ImportOptions
from stereophd.io.outputs.json_text import infinity_as_text, plain
from stereophd.io.outputs.provenance import ConfigRecord, sha256_of
from stereophd.io.tables.trajectories import pack_poses, read_trajectory
from stereophd.wording import LOGGER

AnyModel = TypeVar("AnyModel", bound=BaseModel)


@dataclass(frozen=True)
class LoadedConfig:
    """A configuration that is complete and valid.

    Attributes
    ----------
    config : the models; ``config.cameras`` is inline (or None where the configuration names none)
    path : the configuration file
    inputs : role (``config``, ``cameras``) -> SHA-256 of the files that were read
    tree : the values of the file and the overrides with their places, without defaults: what `variant` changes
    """

    config: Config
    path: Path
    inputs: dict[str, str]
    tree: Tree = field(default_factory=lambda: Tree({}), repr=False, compare=False)

    @property
    def cameras(self) -> dict[str, CameraConfig]:
        """Name -> camera, in the order that decides ties; empty where the configuration names none.

        That of bodies is the order of the names: tracks do not depend on the order in which cameras are listed.
        """
        cameras = self.config.cameras if isinstance(self.config.cameras, dict) else {}
        return cameras if isinstance(self.config.object, PointSettings) else dict(sorted(cameras.items()))

    @property
    def estimated_cameras(self) -> list[str]:
        """Names of the cameras whose detectors are to be estimated from the log."""
        everything = self.config.detector == "estimate"
        return [name for name, camera in self.cameras.items() if camera.detector.estimate or everything]

    @cached_property
    def resolved(self) -> dict[str, Any]:
        """All values including defaults, cameras inline, as JSON-able data; loading it gives the same."""
        values: dict[str, Any] = infinity_as_text(self.config.model_dump(mode="json"))
        return values

    @cached_property
    def sha256(self) -> str:
        """Hash of the canonical JSON of `resolved`."""
        return sha256_of(self.resolved)

    @property
    def record(self) -> ConfigRecord:
        """The record of this configuration for the provenance of an output."""
        return ConfigRecord(self.resolved, self.sha256, self.inputs, self.config.seed, self.config.units.length)

    def build_cameras(self, to_calibrate: bool = False) -> tuple[Camera, ...]:
        """Return the geometric cameras in order; those `to_calibrate` may have unknown focal lengths.

        Raises
        ------
        InputError
            The configuration names no cameras, or a value of a camera is unknown.
        """
        if not self.cameras:
            raise InputError(f"{self.path}: cameras: expected cameras (here or by `cameras_path`), found none")
        for name, camera in self.cameras.items():
            if (key := camera.unknown_key) is not None and not (to_calibrate and key == "intrinsics.focal"):
                raise InputError(
                    f"{self.path}: cameras.{name}.{key}: expected a value, found unknown: run `calibrate` first; it "
                    "writes a cameras.yaml with this value"
                )
        return tuple(camera.build(name) for name, camera in self.cameras.items())


def load_config(
    path: Path | str, overrides: Sequence[str] = (), seed: int | None = None, cameras_path: Path | str | None = None
) -> LoadedConfig:
    """Load a configuration file.

    Parameters
    ----------
    path
        The YAML file, or the folder whose ``config.yaml`` it is; a path of cameras in it is relative to its folder.
    overrides
        ``key.path=value`` with a YAML value each, later ones win.
    seed
        Replaces ``seed``.
    cameras_path
        A ``cameras.yaml`` that replaces the configuration's cameras, but for detectors that it does not state.
        Overrides of single values of a camera apply to it.

    Raises
    ------
    InputError
        A file cannot be read or is not valid: one line for each fault, with file, line,
        key path, what was expected and found, and the nearest key for an unknown one.
    """
    source = Path(path, "config.yaml") if Path(path).is_dir() else Path(path)
    tree, content = read_yaml(source)
    inputs = {"config": hashlib.sha256(content).hexdigest()}
    return _completed(tree, source, inputs, source.parent, overrides, seed, cameras_path)


def _completed(
    tree: Tree, source: Path, inputs: dict[str, str], folder: Path,
    overrides: Sequence[str], seed: int | None, cameras_path: Path | str | None,
) -> LoadedConfig:  # fmt: skip
    """Return the configuration of values, with cameras, overrides and a seed; paths in it are relative to `folder`."""
    _require_mapping(tree)
    changes = [parse_override(text) for text in overrides]
    # An override `cameras=FILE` decides which cameras are read; all other overrides may reach into them.
    for key, change in changes:
        if key == ("cameras",):
            apply_override(tree, key, change)
    if cameras_path is not None:
        if any(key == ("cameras",) for key, _ in changes):
            raise InputError("expected one of `cameras_path` and `overrides` cameras=..., found both")
        cameras_file: Path | None = Path(cameras_path)
        inline = tree.data.get("cameras")
    elif isinstance(tree.data.get("cameras"), str):
        cameras_file = folder / tree.data["cameras"]
    else:
        cameras_file = None
    unit: str | None = None
    if cameras_file is not None:
        unit, inputs["cameras"] = _inline_cameras(tree, cameras_file)
        if cameras_path is not None:
            _keep_detectors(inline, tree.data.get("cameras"), cameras_file)
    else:
        _inline_trajectories(tree, folder)
    for key, change in changes:
        if key != ("cameras",):
            apply_override(tree, key, change)
    _inline_trajectories(tree, Path())  # those that overrides name
    if seed is not None:
        apply_override(tree, ("seed",), Tree(seed, {(): Place("`seed`")}))
    config = _validate(Config, tree)
    _check_camera_of_reports(config, tree)
    if unit is not None and unit != config.units.length:
        raise InputError(f"{cameras_file}: units.length: expected {config.units.length} as in {source}, found {unit}")
    return LoadedConfig(config, source, inputs, tree)


def as_config(
    config: LoadedConfig | Path | str | Mapping[str, Any],
    overrides: Sequence[str] = (),
    seed: int | None = None,
    cameras_path: Path | str | None = None,
) -> LoadedConfig:
    """Return a configuration that is given as a path, as values, or loaded, with the changes of `load_config`.

    What is none of these raises `InputError`.
    """
    if isinstance(config, str | Path):
        return load_config(config, overrides, seed, cameras_path)
    if isinstance(config, Mapping):
        return make_config(config, "configuration", overrides, seed, cameras_path)
    if not isinstance(config, LoadedConfig):
        kind = type(config).__name__
        raise InputError(f"configuration: expected a path, a mapping or what `load_config` returns, found {kind}")
    if not overrides and seed is None and cameras_path is None:
        return config
    tree, folder = copy.deepcopy(config.tree), config.path.parent
    return _completed(tree, config.path, dict(config.inputs), folder, overrides, seed, cameras_path)


def _keep_detectors(before: Any, after: Any, path: Path) -> None:
    """Keep the detectors of a configuration, such as those that `init` estimated, of cameras whose file states none.

    Those that it replaces are named.
    """
    if not isinstance(before, dict) or not isinstance(after, dict):
        return

    def detector(cameras: dict[str, Any], name: str) -> Any:
        return cameras[name].get("detector") if isinstance(cameras.get(name), dict) else None

    names = []
    for name in after:
        stated, replaced = detector(after, name), detector(before, name)
        if stated is None and replaced is not None and isinstance(after[name], dict):
            after[name]["detector"] = copy.deepcopy(replaced)
        elif replaced not in (None, stated):
            names.append(name)
    if names:
        LOGGER.warning(
            "%s: its detectors replace those of the configuration (%s), such as `init` estimated: copy these into it "
            "to keep them", path, ", ".join(map(str, names)),
        )  # fmt: skip


def make_config(
    values: Mapping[str, Any],
    name: str = "configuration",
    overrides: Sequence[str] = (),
    seed: int | None = None,
    cameras_path: Path | str | None = None,
) -> LoadedConfig:
    """Make a configuration from values in memory, as a file holds them.

    The values are sections and keys, such as ``{"filter": {"kind": "pmb", ...}}``; arrays and tuples count as lists.
    Messages call the configuration by the name. The other parameters are those of `load_config`. Raises InputError, as
    it does, if a value is not valid.
    """
    tree = Tree(plain(values, float), {(): Place(name)})  # as a file holds them: mappings, lists and scalars
    return _completed(tree, Path(name), {}, Path(), overrides, seed, cameras_path)


def variant(loaded: LoadedConfig, settings: Sequence[tuple[str, Mapping[str, Any]]]) -> LoadedConfig:
    """Return a configuration with some values changed.

    Each of the settings is where a change is written (for messages), and dotted key path -> value; later ones win.
    Raises InputError as `load_config`.
    """
    tree = copy.deepcopy(loaded.tree)
    for where, changes in settings:
        for key, value in changes.items():
            change = Tree(copy.deepcopy(value), {(): Place(f"{loaded.path}: {where}")})
            apply_override(tree, key_path(key), change)
    _inline_trajectories(tree, loaded.path.parent)
    return LoadedConfig(_validate(Config, tree), loaded.path, loaded.inputs, tree)


def _read_camera_tree(path: Path) -> tuple[Tree, bool, str]:
    """Read a file of cameras, native or of another program, in the native form: ``units`` and ``cameras``.

    Returns with it whether the file (or its format) states the unit of length, else that of the configuration is
    assumed, and the hash of the bytes that were read. Raises InputError when the file cannot be read, or its format is
    unknown.
    """
    refused: InputError | None = None
    try:
        tree, content = read_yaml(path, "file of cameras")
        if isinstance(tree.data, dict) and {"units", "cameras"} <= tree.data.keys():
            return tree, True, hashlib.sha256(content).hexdigest()
    except InputError as error:
        refused = error
    # Imported here: native files do not need the other formats.
    from stereophd.io.interchange.registry import read_foreign_cameras

    foreign = read_foreign_cameras(path)
    if foreign is None:
        if refused is not None:
            raise refused
        return tree, True, hashlib.sha256(content).hexdigest()
    from stereophd.io.cameras.writing import plain_cameras

    form, recording = foreign
    for sentence in (f"read as {form}", *recording.assumed):
        LOGGER.info("%s: %s", path, sentence)
    for sentence in recording.warnings:
        LOGGER.warning("%s", sentence)
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in recording.files)).hexdigest()
    data = {"units": {"length": recording.length_unit or "m"}, "cameras": plain_cameras(recording.cameras)}
    return Tree(data, dict.fromkeys(((), ("cameras",)), Place(str(path)))), not recording.unit_is_assumed, digest


def load_cameras(path: Path | str) -> CamerasFile:
    """Load a file of cameras without a configuration.

    It is a ``cameras.yaml``, or a file of another program, recognised by its content. Raises InputError as
    `load_config`.
    """
    tree, _, _ = _read_camera_tree(Path(path))
    _inline_trajectories(tree, Path(path).parent)
    return _validate(CamerasFile, tree)


def read_camera_file(
    path: Path, options: ImportOptions | None = None
) -> tuple[dict[str, CameraConfig], str, list[str]]:
    """Return the cameras of a native or foreign file, their unit of length, and what was assumed.

    Raises InputError as `load_cameras`, or of the foreign format.
    """
    # Imported here: configurations with native cameras do not need the other formats.
    from stereophd.io.interchange.registry import read_foreign_cameras

    foreign = read_foreign_cameras(path, options)
    if foreign is not None:
        name, recording = foreign
        assert recording.length_unit is not None
        for sentence in recording.warnings:
            LOGGER.warning("%s: %s", path, sentence)
        return recording.cameras, recording.length_unit, [f"{path.name}: read as {name}", *recording.assumed]
    if path.is_dir():
        raise InputError(f"{path}: expected a file of cameras, or a folder that holds one, found a folder without one")
    file = load_cameras(path)
    return dict(file.cameras), file.units.length, []


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration, as editors use it."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **_schema(Config)}


def schema_text() -> str:
    """Return the text of ``configs/schema.json``."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"


@lru_cache
def _schema(model: type[BaseModel]) -> Mapping[str, Any]:
    return model.model_json_schema()


def _require_mapping(tree: Tree) -> None:
    if not isinstance(tree.data, dict):
        found = "an empty file" if tree.data is None else "a list" if isinstance(tree.data, list) else "a value"
        raise InputError(f"{tree.place(())}: expected a mapping of keys to values, found {found}")


def _validate(model: type[AnyModel], tree: Tree) -> AnyModel:
    """Validate strictly: a text is not a number, true is not 1."""
    _require_mapping(tree)
    try:
        # Through JSON, because only there lists count as tuples in strict validation.
        return model.model_validate_json(json.dumps(tree.data), strict=True)
    except ValidationError as error:
        details = error.errors(include_url=False, include_input=False)
        message = describe([dict(detail) for detail in details], tree, _schema(model))
        raise InputError(message) from None


def _check_camera_of_reports(config: Config, tree: Tree) -> None:
    times, cameras = config.report.times, config.cameras
    if isinstance(times, CameraTimes) and isinstance(cameras, dict) and times.camera not in cameras:
        path = ("report", "times")
        raise InputError(f"{tree.place(path)}: report.times: {unknown_camera(times.camera, cameras)}")


def _inline_cameras(tree: Tree, path: Path) -> tuple[str | None, str]:
    """Put the cameras of a file into the tree; return their unit of length, if stated, and the file's hash."""
    cameras, has_unit, digest = _read_camera_tree(path)
    _inline_trajectories(cameras, path.parent)
    checked = _validate(CamerasFile, cameras)
    apply_override(tree, ("cameras",), cameras, ("cameras",))
    tree.data.pop("cameras_covariance", None)
    if checked.covariance:
        apply_override(tree, ("cameras_covariance",), cameras, ("covariance",))
    return checked.units.length if has_unit else None, digest


def _inline_trajectories(tree: Tree, folder: Path) -> None:
    """Put the poses of trajectory files into the tree, so that what is resolved needs no other file."""
    cameras = tree.data.get("cameras") if isinstance(tree.data, dict) else None
    if not isinstance(cameras, dict):
        return
    units = tree.data.get("units")
    unit = units.get("length") if isinstance(units, dict) else None
    for name, camera in cameras.items():
        pose = camera.get("pose") if isinstance(camera, dict) else None
        if not isinstance(pose, dict) or not isinstance(pose.get("trajectory"), str):
            continue
        file = folder / pose["trajectory"]
        try:
            trajectory = read_trajectory(file, unit if isinstance(unit, str) else None)
        except InputError as error:
            where = tree.place(("cameras", name, "pose", "trajectory"))
            raise InputError(f"{where}: cameras.{name}.pose.trajectory: {error}") from None
        pose["trajectory"] = {"file": file.name, "poses": pack_poses(trajectory)}
