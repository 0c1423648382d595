"""`report.smooth.reassociate` in a whole run: tracks, associations and counts change together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.errors import InputError
from stereophd.pipeline.tracking import smoothed
from stereophd.pipeline.tracking.tracking_run import build_tracking
from tests.conftest import leave_out_checks

pytestmark = pytest.mark.usefixtures("without_checks")

CONFIG = "configs/board_calibration.yaml"
SHORT = ["simulate.duration_s=2.0", "report.associations=true"]
KEY = ["camera", "u_px", "v_px"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, tuple[dict[str, Any], pd.DataFrame]]:
    """Report, and associations with the true objects, of a short scene, without and with the option."""
    folder = tmp_path_factory.mktemp("board")
    scene = folder / "scene"
    simulate(load_config(CONFIG, [*SHORT, "seed=0"]), scene)
    truth = pd.read_parquet(scene / "detections.parquet")[[*KEY, "object_id"]]
    out = {}
    for anew in (False, True):
        tracks = folder / f"tracks{anew}"
        changes = [*SHORT, f"report.smooth={{reassociate: {str(anew).lower()}}}"]
        with pytest.MonkeyPatch.context() as patch:
            leave_out_checks(patch)
            report = track(load_config(CONFIG, changes), scene / "detections.parquet", tracks)
        out[anew] = report, pd.read_parquet(tracks / "associations.parquet").merge(truth, on=KEY)
    return out


def _probable(found: pd.DataFrame) -> pd.DataFrame:
    """The detections that tracks have."""
    return found[found.probability > 0.5]


def _wrong(found: pd.DataFrame) -> int:
    """Detections of another object than most of the track's."""
    found = _probable(found)
    most = found.groupby("track_id").object_id.transform(lambda own: own.mode()[0])
    return int((most != found.object_id).sum())


def test_fewer_detections_are_of_a_neighbour(runs: dict[bool, tuple[dict[str, Any], pd.DataFrame]]) -> None:
    before, after = (_wrong(runs[anew][1]) for anew in (False, True))
    assert before > 0
    assert after < 0.5 * before
    before, after = (len(_probable(runs[anew][1])) for anew in (False, True))
    assert after >= before


def test_a_detection_has_one_track_and_is_counted_once(
    runs: dict[bool, tuple[dict[str, Any], pd.DataFrame]],
) -> None:
    report, rows = runs[True]
    found = _probable(rows)
    assert not found.duplicated(KEY).any()
    assert not found.duplicated(["track_id", "camera", "frame"]).any()
    counted = sum(sum(one["n_detections"].values()) for one in report["tracks"])
    assert counted == len(found)


def test_probabilities_of_a_detection_add_up_to_at_most_one(
    runs: dict[bool, tuple[dict[str, Any], pd.DataFrame]],
) -> None:
    """What a track was given anew is its own alone, with probability 1; without the option nothing is that certain."""
    for anew, (_, found) in runs.items():
        assert not found.duplicated([*KEY, "frame", "track_id"]).any()
        sums = found.groupby([*KEY, "frame"]).probability.transform("sum")
        assert sums.max() < 1.0 + 1e-9
        chosen = found.probability == 1.0
        assert chosen.any() == anew
        assert not found[chosen].duplicated([*KEY, "frame"]).any()
        assert (sums[chosen] == 1.0).all()


def test_what_a_track_that_is_not_written_was_given_keeps_the_rows_of_others(
    runs: dict[bool, tuple[dict[str, Any], pd.DataFrame]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filtered, chosen = (runs[anew][1] for anew in (False, True))
    given = chosen[chosen.probability == 1.0]
    key = [*KEY, "frame"]
    others = filtered.merge(given[[*key, "track_id"]], on=key, suffixes=("", "_given"))
    others = others[others.track_id != others.track_id_given]
    left_out = int(others.track_id_given.mode()[0])
    is_written = smoothed._is_written
    monkeypatch.setattr(smoothed, "_is_written", lambda one, *rest: one.track_id != left_out and is_written(one, *rest))
    config = load_config(CONFIG, [*SHORT, "report.smooth={reassociate: true}"])
    simulate(load_config(CONFIG, [*SHORT, "seed=0"]), tmp_path / "scene")
    track(config, tmp_path / "scene" / "detections.parquet", tmp_path / "tracks")
    found = pd.read_parquet(tmp_path / "tracks" / "associations.parquet")
    assert left_out not in set(found.track_id)
    # all that the others had before, and claims of others to what the track was given
    kept = chosen[chosen.track_id != left_out]
    assert len(kept.merge(found, on=[*key, "track_id", "probability"])) == len(kept)
    further = found.merge(given[given.track_id == left_out][key], on=key)
    assert len(further) > 0
    assert len(found) == len(kept) + len(further)
    assert found.groupby(key).probability.sum().max() < 1.0 + 1e-9


@pytest.mark.parametrize(
    ("config", "change", "reason"),
    [
        ("paper/single_object.yaml", "seed=1", "filter.kind is single"),
        ("quickstart.yaml", "motion={model: static}", "motion.model is static"),
        ("quickstart.yaml", "report.times=grid 0.1", "report.times is a grid"),
    ],
)
def test_where_tracks_cannot_choose_anew_the_option_is_refused(config: str, change: str, reason: str) -> None:
    path = Path(__file__).parents[3] / "configs" / config
    loaded = load_config(path, ["report.smooth={reassociate: true}", change])
    with pytest.raises(InputError, match=rf"report.smooth.reassociate: expected false where {reason}"):
        build_tracking(loaded)
