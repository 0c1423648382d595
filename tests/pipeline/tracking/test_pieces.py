"""A log in pieces: the tracks of the whole run, whoever makes the pieces and whatever is killed."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.commands.options import TrackOptions
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.trajectories.joins import join_probabilities
from stereophd.core.trajectories.smoothing import Trajectory
from stereophd.errors import InputError
from stereophd.io.logs.reading import Frame, LogReader
from stereophd.io.tables import writing
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.tracking import pieces
from stereophd.pipeline.tracking.pieces import overlap_of, plan_pieces
from tests.commands.test_batches import SCENE

from .test_unfinished import Killed, files

pytestmark = pytest.mark.usefixtures("without_checks")

LENGTH, OVERLAP = 10.0, 5.0


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[LoadedConfig, Path]:
    """Half a minute of two objects."""
    folder = tmp_path_factory.mktemp("pieces")
    (folder / "scene.yaml").write_text(SCENE)
    changes = ["simulate.duration_s=30.0", "simulate.given=[{position: [0, 0, 100]}, {position: [9, 5, 90]}]"]
    loaded = load_config(folder / "scene.yaml", changes)
    simulate(loaded, folder / "scene")
    return loaded, folder / "scene" / "detections.parquet"


def estimates(folder: Path) -> set[tuple[float, str, int]]:
    table = pq.read_table(folder / "tracks.parquet", columns=["time_s", "camera", "track_id"]).to_pydict()
    return set(zip(*table.values(), strict=True))


def test_the_tracks_are_those_of_the_whole_run(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> None:
    whole = track(*scene, tmp_path / "whole")
    report = track(*scene, tmp_path / "pieces", pieces_s=LENGTH, overlap_s=OVERLAP)
    assert report["pieces"]["count"] == 3
    assert report["pieces"]["joined_tracks"] == 4
    assert report["input"] == whole["input"]
    assert report["events"] == whole["events"]
    assert estimates(tmp_path / "pieces") == estimates(tmp_path / "whole")
    scans = [pq.read_table(tmp_path / name / "scans.parquet") for name in ("whole", "pieces")]
    for column in ("time_s", "camera", "frame", "n_detections"):
        assert scans[0][column].equals(scans[1][column])


def test_two_processes_give_the_bytes_of_one(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> None:
    loaded, log = load_config(scene[0].path, ["report.smooth={}", "report.associations=true"]), scene[1]
    track(loaded, log, tmp_path / "one", pieces_s=LENGTH, overlap_s=OVERLAP)
    track(loaded, log, tmp_path / "two", pieces_s=LENGTH, overlap_s=OVERLAP, jobs=2)
    assert files(tmp_path / "two") == files(tmp_path / "one")
    assert len({identity for _, _, identity in estimates(tmp_path / "one")}) == 2
    # successive residuals of the filter are those of the tracks of the run, across the joins
    track(scene[0], log, tmp_path / "filtered", pieces_s=LENGTH, overlap_s=OVERLAP)
    figures = [json.loads((tmp_path / name / "report.json").read_text()) for name in ("one", "filtered")]
    assert figures[0]["track_errors"] == figures[1]["track_errors"]


def test_the_times_of_a_grid_are_those_of_the_whole_run(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> None:
    loaded, log = load_config(scene[0].path, ["report.times=grid 0.3"]), scene[1]
    track(loaded, log, tmp_path / "one", pieces_s=LENGTH, overlap_s=OVERLAP)
    track(loaded, log, tmp_path / "whole")
    assert estimates(tmp_path / "one") == estimates(tmp_path / "whole")


def test_finished_pieces_survive_a_kill(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    track(*scene, tmp_path / "whole", pieces_s=LENGTH, overlap_s=OVERLAP)

    def tick(done: int, total: int) -> None:
        if (done, total) == (2, 3):
            raise Killed

    with pytest.raises(Killed):
        track(*scene, out, pieces_s=LENGTH, overlap_s=OVERLAP, progress=tick)
    kept = sorted(path.name for path in out.glob("partial-*/*.saved"))
    assert kept == ["piece-00000.saved", "piece-00001.saved"]
    made: list[int] = []
    one = pieces.track_piece

    def counted(work: pieces.PieceWork, piece: pieces.LogPiece, tick: None = None) -> int:
        made.append(piece.number)
        return one(work, piece)

    monkeypatch.setattr(pieces, "track_piece", counted)
    track(*scene, out, pieces_s=LENGTH, overlap_s=OVERLAP, resume=True)
    assert made == [2]
    assert files(out) == files(tmp_path / "whole")
    # A forced repetition that was killed left pieces beside the finished tracks: nothing else would ever remove them.
    with pytest.raises(Killed):
        track(*scene, out, pieces_s=LENGTH, overlap_s=OVERLAP, progress=tick, force=True)
    assert list(out.glob("partial-*/*.saved"))
    track(*scene, out, pieces_s=LENGTH, overlap_s=OVERLAP, resume=True)
    assert files(out) == files(tmp_path / "whole")


def test_pieces_of_one_object(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> None:
    """The estimator of one object calls it 0 in every piece."""
    from ..test_stream import SINGLE

    loaded = load_config(SINGLE, ["simulate.duration_s=30.0"])
    simulate(loaded, tmp_path / "scene")
    log = tmp_path / "scene" / "detections.parquet"
    whole = track(loaded, log, tmp_path / "whole")
    report = track(loaded, log, tmp_path / "out", pieces_s=LENGTH, overlap_s=OVERLAP)
    assert report["reports"] == whole["reports"]
    assert [one["track_id"] for one in report["tracks"]] == [0]


def test_overlaps_longer_than_a_piece_are_refused() -> None:
    assert overlap_of(1800.0, None) == 60.0
    assert overlap_of(4.0, None) == 4.0
    for overlap in (5.0, math.nan):
        with pytest.raises(InputError, match="`overlap_s`: expected"):
            overlap_of(4.0, overlap)
    refused = (
        (0.0, "a number above 0, found 0"),
        (np.float32(-0.5), "a number above 0, found -0.5"),
        (math.inf, "a finite number, found inf"),
    )
    for length, expected in refused:
        with pytest.raises(InputError, match=f"`pieces_s`: expected {expected}$"):
            TrackOptions(pieces_s=length)


def frames(*times: float) -> list[Frame]:
    return [Frame(time_s, 0, k, np.empty((0, 2))) for k, time_s in enumerate(times)]


def test_plan() -> None:
    one, two, three = plan_pieces(frames(*np.arange(5.0, 35.5, 0.5)), 10.0, 2.0, ahead=True)
    assert (one.to_s, two.from_s, two.to_s, three.from_s) == (15.0, 15.0, 25.0, 25.0)
    assert (two.begin_s, two.end_s) == (13.0, 27.0)
    assert (one.begin_s, three.end_s) == (-np.inf, np.inf)
    assert [piece.events_before for piece in (one, two, three)] == [0, 16, 36]


@pytest.mark.parametrize(("last_s", "count"), [(0.0, 1), (11.0, 1), (12.0, 2), (21.0, 2), (500.0, 50)])
def test_the_last_piece_is_at_least_as_long_as_the_overlap(last_s: float, count: int) -> None:
    assert len(plan_pieces(frames(*np.linspace(0.0, last_s, 101)), 10.0, 2.0, ahead=False)) == count


def trajectory(track_id: int, x: float, events: range, spread: float = 1.0) -> Trajectory:
    count = len(events)
    states = np.zeros((count, 6))
    states[:, 0] = x
    covariances = np.broadcast_to(np.eye(6) * spread, (count, 6, 6))
    return Trajectory(track_id, np.array(events), np.array(events) * 1.0, states, covariances, np.ones(count))


def test_probabilities_of_two_pairs_are_those_of_all_ways_to_pair_them() -> None:
    times = np.arange(10.0)
    left = [trajectory(0, 0.0, range(10)), trajectory(1, 2.0, range(10))]
    right = [trajectory(5, 0.5, range(10)), trajectory(6, 2.0, range(10))]
    pairs = join_probabilities(left, right, times, 10.0, 5.0)
    squared = np.array([[0.25, 4.0], [2.25, 0.0]]) / 2.0
    odds = np.exp((16.81 - squared) / 2.0)
    ways = {"both": odds[0, 0] * odds[1, 1], "crossed": odds[0, 1] * odds[1, 0]}
    single = odds.sum() + 1.0
    total = sum(ways.values()) + single
    expected = {(0, 0): (ways["both"] + odds[0, 0]) / total, (0, 1): (ways["crossed"] + odds[0, 1]) / total}
    found = {(i, j): p for i, j, p in zip(pairs.before, pairs.after, pairs.probabilities, strict=True)}
    for pair, probability in expected.items():
        assert found[pair] == pytest.approx(probability, rel=1e-6)


def test_a_track_that_ended_earlier_gives_way_to_the_one_at_the_join() -> None:
    left = [trajectory(0, 0.0, range(6)), trajectory(1, 0.0, range(6, 20))]
    pairs = join_probabilities(left, [trajectory(7, 0.0, range(20))], np.arange(20.0), 20.0, 5.0)
    assert dict(zip(pairs.before.tolist(), (pairs.probabilities > 0.5).tolist(), strict=True)) == {0: False, 1: True}


def test_far_tracks_are_no_pair() -> None:
    pairs = join_probabilities(
        [trajectory(0, 0.0, range(5))], [trajectory(1, 50.0, range(5))], np.arange(5.0), 5.0, 5.0
    )
    assert len(pairs.before) == 0
    assert len(join_probabilities([], [], np.empty(0), 0.0, 5.0).before) == 0


def test_a_reader_passes_over_early_row_groups(
    scene: tuple[LoadedConfig, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "ROW_GROUP_ROWS", 20)
    loaded, log = scene
    table = pq.read_table(log)
    with TableWriter(tmp_path / "log.parquet", table.schema) as writer:
        writer.append({name: _plain(table[name]) for name in table.schema.names})
    cameras = loaded.build_cameras()
    whole = [(f.time_s, f.camera, f.frame) for f in LogReader(tmp_path / "log.parquet", cameras)]
    reader = LogReader(tmp_path / "log.parquet", cameras, from_s=15.0)
    late = [(f.time_s, f.camera, f.frame) for f in reader]
    assert len(late) < 0.7 * len(whole)
    assert [frame for frame in late if frame[0] >= 15.0] == [frame for frame in whole if frame[0] >= 15.0]
    assert reader.counts["rows"] < table.num_rows


def _plain(column: object) -> list[object]:
    return column.to_pylist()  # type: ignore[attr-defined, no-any-return]


def test_a_damaged_piece_is_an_error(scene: tuple[LoadedConfig, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"

    def tick(done: int, total: int) -> None:
        if done == 1:
            raise Killed

    with pytest.raises(Killed):
        track(*scene, out, pieces_s=LENGTH, overlap_s=OVERLAP, progress=tick)
    (done,) = out.glob("partial-*/piece-*.saved")
    done.write_bytes(done.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"piece-00000\.saved"):
        track(*scene, out, pieces_s=LENGTH, overlap_s=OVERLAP, resume=True)
    shutil.rmtree(out)


def test_spans_without_a_frame_have_no_piece() -> None:
    found = plan_pieces(frames(0.0, 1.0, 11.0, 86_400.0, 86_401.0), 4.0, 1.0, ahead=False)
    assert [(piece.number, piece.from_s, piece.to_s, piece.events_before) for piece in found] == [
        (0, -math.inf, 4.0, 0),
        (1, 8.0, 12.0, 2),
        (2, 86_400.0, math.inf, 3),
    ]
    assert found[2].begin_s == 86_399.0
    # The next span begins within the overlap of a frame: what is tracked with it does, too.
    found = plan_pieces(frames(0.0, 3.5, 5.0, 9.5), 4.0, 1.0, ahead=True)
    assert [(piece.from_s, piece.events_before) for piece in found] == [(-math.inf, 0), (4.0, 1), (8.0, 3)]
