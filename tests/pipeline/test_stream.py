"""Frames as events, and the loop over them: counts, the same events from a log and from memory, saved states."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.commands.simulate import simulate
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.disparity.events import Event
from stereophd.errors import InputError
from stereophd.io.logs.reading import Frame
from stereophd.io.outputs.saved import decoder, encode
from stereophd.pipeline.stream import EventStream, open_stream
from stereophd.pipeline.tracking.loop import Record, ReportTimes, RunState, run_estimator
from stereophd.pipeline.tracking.tracking_run import build_tracking
from stereophd.pipeline.tracking.unfinished import state_type
from tests.commands.test_track import SCENE
from tests.core.disparity.cases import LENSES, make_camera

SINGLE = Path(__file__).parents[2] / "configs" / "paper" / "single_object.yaml"


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[LoadedConfig, Path]]:
    """Ten seconds of several objects, and of one."""
    folder = tmp_path_factory.mktemp("scenes")
    (folder / "scene.yaml").write_text(SCENE)
    out = {}
    for name, path in {"many": folder / "scene.yaml", "one": SINGLE}.items():
        loaded = load_config(path, ["simulate.duration_s=10.0"])
        simulate(loaded, folder / name)
        out[name] = loaded, folder / name / "detections.parquet"
    return out


def test_events_carry_the_number_of_their_frame_and_what_was_left_out() -> None:
    camera = make_camera(lens=LENSES["radial"])
    far = [400.0 + 1.5 * 898.9, 300.0]  # no ray ends there, as in tests/core/multi/test_events.py
    frames = [
        Frame(0.0, 0, 7, np.array([[300.0, 200.0], far])),
        Frame(0.5, 0, 8, np.empty((0, 2))),
        Frame(1.0, 0, 9, np.array([far]), np.ones((1, 2))),
    ]
    stream = EventStream([camera], frames)
    for _ in range(2):  # every iteration counts anew
        events = list(stream)
        assert [event.frame for event in events] == [7, 8, 9]
        assert [len(event.points) for event in events] == [1, 0, 0]
        assert [event.not_invertible for event in events] == [1, 0, 1]
        assert [event.own_noise for event in events] == [False, False, True]
        assert stream.counts == {"not_invertible": 2}
    assert [event.frame for event in EventStream([camera], frames, from_s=0.5)] == [8, 9]
    assert [event.frame for event in EventStream([camera], frames, until_s=0.2)] == [7, 8]


def test_progress_ends_with_all_rows(scenes: dict[str, tuple[LoadedConfig, Path]]) -> None:
    loaded, log = scenes["many"]
    seen: list[tuple[int, int]] = []
    stream = open_stream(loaded.config, loaded.build_cameras(), log, lambda done, total: seen.append((done, total)))
    assert len(list(stream)) == stream.counts["frames"]
    assert seen[-1] == (stream.counts["rows"], stream.counts["rows"])
    assert sorted(seen) == seen


def rows(records: list[Record]) -> list[tuple[object, ...]]:
    """What a record writes, comparable to the bit."""
    return [
        (
            r.time_s, r.camera, r.frame, r.n_detections, r.first_label, r.reported, r.is_event,
            r.info.log_likelihood, r.info.cardinality_mean, dict(r.attributed), r.estimates.track_ids.tolist(),
            r.estimates.states.tobytes(), r.estimates.covariances.tobytes(), r.estimates.existence.tobytes(),
        )
        for r in records
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["many", "one"])
def test_a_run_continues_from_a_copy_of_its_state(scenes: dict[str, tuple[LoadedConfig, Path]], name: str) -> None:
    """Cut after any record, an event or a time of the grid, the rest is that of the whole run."""
    loaded, log = scenes[name]
    tracking = build_tracking(loaded)
    times = ReportTimes(grid_s=0.35)

    def stream(skip: int = 0) -> Iterator[Event]:
        return islice(open_stream(loaded.config, tracking.cameras, log), skip, None)

    whole = list(run_estimator(tracking.estimator, stream(), times))
    assert not all(record.is_event for record in whole)
    for cut in (1, 10, 11, 12):
        run = RunState(tracking.estimator.init())
        records = run_estimator(tracking.estimator, stream(), times, run=run)
        first = list(islice(records, cut))
        kind: Any = RunState
        saved = decoder(kind[state_type(run.estimator)])(encode(run))
        more = list(records)  # the run goes on; the copy stays as it was
        rest = list(run_estimator(tracking.estimator, stream(saved.events), times, run=saved))
        assert rows(first) + rows(rest) == rows(whole)
        assert rows(more) == rows(rest)


def test_a_log_that_loses_more_than_a_few_rows_is_refused(
    scenes: dict[str, tuple[LoadedConfig, Path]], tmp_path: Path
) -> None:
    """A twentieth at most: here the first 2 and 20 % of the frames have times minutes too late."""
    loaded, path = scenes["many"]
    table = pq.read_table(path)
    loaded = load_config(loaded.path, ["simulate.duration_s=10.0", "input.on_bad_row=drop"])
    for share in (0.02, 0.2):
        head = np.arange(table.num_rows) < share * table.num_rows
        times = pa.array(table["time_s"].to_numpy() + 300.0 * head)
        column = table.schema.get_field_index("time_s")
        pq.write_table(table.set_column(column, "time_s", times), tmp_path / "log.parquet")
        stream = open_stream(loaded.config, loaded.build_cameras(), tmp_path / "log.parquet")
        if share < 0.05:
            assert len(list(stream)) > 0
            assert stream.counts["time_backwards"] == head.sum()
            continue
        with pytest.raises(InputError, match=r"expected at most 5 % of the rows to be bad, found .*time_backwards"):
            list(stream)
