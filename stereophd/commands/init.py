"""Write a commented configuration for a log and its cameras, each value with its source."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import stereophd
from stereophd.commands.options import InitOptions
from stereophd.config.loading import load_cameras, load_config, make_config
from stereophd.config.yaml import Tree, apply_override, parse_override
from stereophd.errors import InputError
from stereophd.io.documents import expecting
from stereophd.io.outputs.atomic import atomic_write
from stereophd.io.outputs.disk import write_error
from stereophd.io.outputs.json_text import REPORT_VERSION
from stereophd.options import takes
from stereophd.pipeline.batch.names import expand
from stereophd.pipeline.checks.check_log import check_log, report_findings
from stereophd.pipeline.checks.finding import is_mistake
from stereophd.pipeline.initial.draft import STEPS, begin, draft_from_log, loaded_draft
from stereophd.pipeline.initial.template import MARK, Draft, Kind, config_text, template
from stereophd.pipeline.inspection.log import summarise_log
from stereophd.site import page
from stereophd.wording import LOGGER

CONFIG_FILE, CAMERAS_FILE = "config.yaml", "cameras.yaml"


@takes(InitOptions)
def init(
    out_dir: Path | str, log_path: Path | str | None = None, cameras_path: Path | str | None = None,
    overrides: Sequence[str] = (), *, options: InitOptions,
) -> dict[str, Any]:  # fmt: skip
    """Write ``config.yaml`` for a log, so that `track` runs with it, or `calibrate` where poses are unknown or wrong.

    Cameras are native or of another program, and by default ``cameras.yaml`` beside the log, if it is there. Values
    that `overrides` give stay as they are. Returns ``config`` (the path), ``length_unit``, ``must_be_calibrated``,
    ``must_be_corrected`` (a mistake is named, which comes first), ``values`` (key, value, source, measured),
    ``detectors`` (by camera, with their sources), ``cameras`` and ``checks``. Raises InputError if the log or the
    cameras are not usable, or the folder holds another ``config.yaml``.
    """
    if log_path is not None:
        [log_path] = expand([log_path])
    target, kind, force = Path(out_dir) / CONFIG_FILE, options.kind or "lab", options.force
    _check_target(target, force)
    cameras_file = _cameras_file(log_path, cameras_path)
    draft = _with_overrides(_begin(cameras_file, log_path, options.length_unit, kind), overrides)
    if log_path is not None and draft.cameras:
        draft = draft_from_log(draft, log_path)
    if draft.must_be_searched:
        from stereophd.pipeline.calibration.found_cameras import refuse_search

        refuse_search(loaded_draft(draft, str(cameras_file)))
    if log_path is not None and draft.cameras:
        begin(STEPS, "the log is checked")
        loaded = loaded_draft(draft, str(target))
        checked = check_log(loaded, log_path, of_rows=False, alone=draft.is_unplaced)
        # a mistake by which the values are chosen is named once; another one is the cause of what the estimates show
        named = {found.name for found in draft.findings} & {"geometry.cause", "geometry.boxes"}
        is_right = not any(map(is_mistake, checked))
        before = (found for found in draft.findings if found.name in named or (is_right and not is_mistake(found)))
        draft = replace(draft, findings=(*before, *(one for one in checked if one.name not in named)))
    sources = [Path(path).name for path in (log_path, cameras_file) if path is not None]
    source = f"from {' and '.join(sources)}" if sources else "without a log"
    _write(target, config_text(draft, stereophd.__version__, source, CAMERAS_FILE), force)
    if draft.cameras:
        load_config(target)
    else:
        LOGGER.warning(
            "%s: no cameras are known: put them into %s beside it, with `pose: unknown` where you know no pose (%s)",
            target, CAMERAS_FILE, page("howto/calibrate"),
        )  # fmt: skip
    return {
        "report_version": REPORT_VERSION,
        "config": str(target),
        "length_unit": draft.unit,
        "must_be_calibrated": draft.must_be_calibrated,
        "must_be_corrected": draft.must_be_corrected,
        "cameras": list(draft.cameras),
        "values": [
            {"key": key, "value": one.value, "source": one.reason, "measured": one.measured}
            for key, one in draft.choices.items()
        ],
        "detectors": {
            name: {**camera.detector.model_dump(mode="json"), "source": "; ".join(draft.camera_notes.get(name, ()))}
            for name, camera in draft.cameras.items()
        },
        "checks": report_findings(draft.findings),
    }


def _with_overrides(draft: Draft, overrides: Sequence[str]) -> Draft:
    cameras = Tree({"cameras": {name: camera.model_dump(mode="json") for name, camera in draft.cameras.items()}})
    values, stated = {}, set[str]()
    for path, change in map(parse_override, overrides):
        if path[0] == "units":
            raise InputError("`overrides` units: expected the unit with `length_unit` or in the cameras, found it here")
        if path[0] == "cameras":
            apply_override(cameras, path, change)
            if path[2:3] == ("detector",) and path[3:] not in ((), ("estimate",)):
                # a detector of which values are given is not estimated, whatever its camera had before
                cameras.data["cameras"][path[1]]["detector"]["estimate"] = False
                stated.add(f"cameras.{path[1]}.detector")
        else:
            values[".".join(map(str, path))] = change.data
    draft = draft.with_given(values)
    if not values and not overrides:
        return draft
    loaded = make_config({**draft.values(), **(cameras.data if draft.cameras else {})}, "`overrides`")
    return replace(draft, cameras=loaded.cameras if draft.cameras else {}, given=draft.given | stated)


def _check_target(target: Path, force: bool) -> None:
    """Refuse to overwrite a configuration that `init` did not write, or any without `force`."""
    if not target.exists():
        return
    with expecting("a configuration", target):
        ours = target.read_text(encoding="utf-8", errors="replace").startswith(MARK)
    if not ours:
        raise InputError(
            f"{target}: expected no configuration, or one of `init`, found another one; choose a new folder"
        )
    if not force:
        raise InputError(f"{target}: expected no configuration, found one; use `force=True` to replace it")


def _cameras_file(log_path: Path | str | None, cameras_path: Path | str | None) -> Path | None:
    if cameras_path is not None:
        return Path(cameras_path)
    if log_path is None:
        return None
    beside = Path(log_path).with_name(CAMERAS_FILE)
    if not beside.exists():
        return None
    LOGGER.info("cameras: %s, beside the log", beside)
    return beside


def _begin(cameras_file: Path | None, log_path: Path | str | None, unit: str | None, kind: Kind) -> Draft:
    """Return the draft of a kind of object, with the cameras as they are."""
    if cameras_file is not None:
        described = load_cameras(cameras_file)
        if unit is not None and unit != described.units.length:
            raise InputError(f"{cameras_file}: units.length: expected {unit}, found {described.units.length}")
        return replace(template(described.units.length, described.cameras, kind), covariance=described.covariance)
    draft = template(unit or "m", {}, kind)
    if log_path is None:
        return draft
    rows = summarise_log(Path(log_path))["cameras"]
    names = ", ".join(f"{name} ({row['rate_hz']:.6g} Hz)" if row.get("rate_hz") else name for name, row in rows.items())
    return Draft(draft.unit, {}, draft.choices, head=(f"The log has the cameras {names}.",))


def _write(target: Path, text: str, force: bool) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(error, target.parent) from error
    with atomic_write(target, replace=force) as path:
        path.write_text(text, encoding="utf-8")
