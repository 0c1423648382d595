"""Tentative objects: which are reported, and how they come into the tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.core.disparity.events import Event
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.pipeline.tracking.loop import run_estimator
from stereophd.pipeline.tracking.run_figures import LastingTracks
from tests.commands.test_track import SCENE

pytestmark = pytest.mark.usefixtures("without_checks")


def objects(labels: list[int], tentative: Estimates | None = None) -> Estimates:
    ids = np.array(labels, dtype=np.int64)
    count = len(labels)
    covariances = np.tile(np.eye(6), (count, 1, 1))
    return Estimates(ids, np.zeros((count, 6)), covariances, np.full(count, 0.8), ids, tentative)


@dataclass(frozen=True)
class Scripted:
    """An estimator that reports what a script says: labels detected, confirmed and tentative after each event."""

    script: tuple[tuple[list[int], list[int], list[int]], ...]

    @property
    def rig(self) -> SimpleNamespace:
        return SimpleNamespace(cameras=[SimpleNamespace(name="left"), SimpleNamespace(name="right")])

    def init(self) -> SimpleNamespace:
        return SimpleNamespace(number=0, next_label=0, labels=np.arange(10))

    def step(self, state: SimpleNamespace, event: Event) -> tuple[SimpleNamespace, Info, Estimates]:
        detected, confirmed, tentative = self.script[state.number]
        info = Info(0.0, 0.0, 0, np.array(detected, dtype=np.int64))
        new = SimpleNamespace(number=state.number + 1, next_label=10, labels=state.labels)
        return new, info, objects(confirmed, objects(tentative) if tentative else None)


class Instant(SimpleNamespace):
    """An event of which the script alone says what it shows."""

    def within(self, rig: SimpleNamespace) -> Instant:
        return self


def events(count: int) -> list[Instant]:
    return [
        Instant(time_s=float(k // 2), camera=k % 2, frame=k // 2, points=[], pixels=None, outside=0)
        for k in range(count)
    ]


def shown(script: list[tuple[list[int], list[int], list[int]]]) -> list[list[int]]:
    """Tentative tracks after each event."""
    records = run_estimator(Scripted(tuple(script)), events(len(script)))
    found = [record.estimates.tentative for record in records]
    return [[] if one is None else one.track_ids.tolist() for one in found]


def test_after_the_first_frames_two_cameras_must_have_seen_a_tentative_object() -> None:
    script = [
        ([1], [], [1]),  # left: the first frame of the log, one camera is enough
        ([2], [], [1, 2]),  # right: the first frame of this camera
        ([2, 3], [], [1, 2, 3]),  # left: both have seen 2 only
        ([1], [], [1, 2, 3]),  # right: now both have seen 1 too
        ([3], [2], [1, 3]),  # left: 2 is confirmed, 3 was seen twice by the same camera
        ([], [2], [1, 3]),
    ]
    assert shown(script) == [[1], [1, 2], [2], [1, 2], [1], [1]]


def test_short_tracks_are_not_tentative_either() -> None:
    script = [([1, 2], [], [1, 2]), ([1, 2], [], [1, 2]), *[([], [1], [])] * 6]
    records = list(LastingTracks(1.0).records(run_estimator(Scripted(tuple(script)), events(8))))
    found = [record.estimates.tentative for record in records[:2]]
    assert [one is not None and one.track_ids.tolist() for one in found] == [[1], [1]]
    assert [record.estimates.track_ids.tolist() for record in records[2:]] == [[1]] * 6


@pytest.mark.parametrize("kind", ["phd", "pmb"])
def test_confirmed_rows_do_not_depend_on_the_tentative_level(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    settings = [
        f"filter.kind={kind}",
        "filter.birth={per_s: 0.2, disparity: {mean_px: 7, std_px: 2.5}, velocity_std: 1.5}",
    ]
    settings += ["simulate.duration_s=8"]
    simulate(load_config(path, settings), tmp_path / "log")
    tables, reports = [], []
    for level in (0.6, 0.99):
        levels = f"filter.extraction={{confirm: 0.99, release: 0.02, tentative: {level}}}"
        out = tmp_path / str(level)
        loaded = load_config(path, [*settings, levels])
        reports.append(track(loaded, tmp_path / "log" / "detections.parquet", out))
        tables.append(pq.read_table(out / "tracks.parquet").to_pandas())
    both, confirmed = tables
    assert set(both["status"]) == {"confirmed", "tentative"}
    assert set(confirmed["status"]) == {"confirmed"}
    columns = ["time_s", "camera", "x", "y", "z", "existence"]
    sure = both[both["status"] == "confirmed"]
    order = ["time_s", "camera", "x"]
    assert (
        sure.sort_values(order)[columns].to_numpy().tolist()
        == confirmed.sort_values(order)[columns].to_numpy().tolist()
    )
    assert (both[both["status"] == "tentative"]["existence"] >= 0.6).all()
    # A tentative object that is confirmed later keeps its identity.
    first = both.groupby("track_id")["status"].first()
    assert (first == "tentative").any()
    assert set(both[both["status"] == "tentative"]["track_id"]) & set(sure["track_id"])
    figures = ("estimates", "events", "log_likelihood")
    assert [reports[0][key] for key in figures] == [reports[1][key] for key in figures]
    assert reports[0]["tentative_estimates"] == len(both) - len(sure) > 0
    assert reports[1]["tentative_estimates"] == 0
