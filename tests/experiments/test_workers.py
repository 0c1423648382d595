"""The same tables from one process, from two, and from a Dask cluster; a worker that dies loses no run."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from stereophd.commands.experiment import experiment
from stereophd.config.loading import load_config
from stereophd.errors import InputError
from stereophd.pipeline.workers import places as workers

from .conftest import CAN_DRAW, Load, write_config
from .test_experiment import contents

pytestmark = pytest.mark.usefixtures("without_figure")

GIVE_UP_S = 60


# Some runs are left when a worker is killed after the third, however slow this process is.
MANY = "experiment.runs=12"


def tables(folder: Path, *overrides: str) -> dict[str, bytes]:
    """The tables of the small experiment from this process."""
    config = write_config(folder / "small.yaml")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CAN_DRAW, lambda: False)
        experiment(load_config(config, overrides), folder / "out")
    return contents(folder / "out")


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return tables(tmp_path_factory.mktemp("one"))


@pytest.fixture(scope="module")
def expected_of_many(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return tables(tmp_path_factory.mktemp("many"), MANY)


def kill_one(pids: Callable[[], list[int]], done_before: int = 3) -> tuple[Callable[[int, int], None], list[int]]:
    """Return a progress function that kills a worker in the middle, and the list of those it killed."""
    killed: list[int] = []

    def progress(done: int, total: int) -> None:
        if done >= done_before and not killed:
            assert done < total
            killed.append(pids()[0])
            os.kill(killed[0], signal.SIGKILL)

    return progress, killed


def local_workers() -> list[int]:
    """Return the worker processes among the children of this process."""
    children = psutil.Process().children()
    return [p.pid for p in children if any("worker_process" in word for word in p.cmdline())]


def test_a_killed_process_loses_no_run(
    load: Load, tmp_path: Path, expected_of_many: dict[str, bytes], caplog: pytest.LogCaptureFixture
) -> None:
    progress, killed = kill_one(local_workers)
    experiment(load(MANY), tmp_path / "killed", jobs=2, progress=progress)
    assert killed
    assert "a worker died" in caplog.text
    assert contents(tmp_path / "killed") == expected_of_many


@pytest.fixture(scope="module")
def cluster() -> Iterator[object]:
    """A local Dask cluster of two worker processes."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs="CRITICAL"
    ) as local:
        yield local


def test_a_killed_worker_of_dask_loses_no_run(
    load: Load, tmp_path: Path, expected_of_many: dict[str, bytes], cluster: object
) -> None:
    def pids() -> list[int]:
        return [nanny.pid for nanny in cluster.workers.values()]  # type: ignore[attr-defined]

    before = set(pids())
    progress, killed = kill_one(pids)
    experiment(load(MANY), tmp_path / "killed", dask=cluster.scheduler_address, progress=progress)  # type: ignore[attr-defined]
    assert killed
    assert killed[0] in before
    assert contents(tmp_path / "killed") == expected_of_many


def test_no_scheduler(load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECT_S", 0.5)
    with pytest.raises(InputError, match="expected the address of a Dask scheduler, found no answer"):
        experiment(load(), tmp_path / "out", dask="tcp://127.0.0.1:9")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_leaves_a_folder_that_can_be_resumed(
    load: Load, path: Path, tmp_path: Path, expected: dict[str, bytes], jobs: int
) -> None:
    out = tmp_path / "out"
    words = [sys.executable, "-m", "stereophd", "experiment", path, "--out", out, "--jobs", jobs]
    many = [*words, "--set", "experiment.runs=200"]
    # in a group of its own, as the foreground job of a shell: all its processes get the signal
    process = subprocess.Popen(
        list(map(str, many)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    waiting = multiprocessing.Event()
    for _ in range(GIVE_UP_S * 20):
        if len(list(out.glob("partial-*/*.saved"))) >= 2 or process.poll() is not None:
            break
        waiting.wait(0.05)
    os.killpg(process.pid, signal.SIGINT)
    printed, messages = process.communicate(timeout=GIVE_UP_S)
    assert process.returncode == 130, messages
    assert printed == ""
    assert "finished runs are kept in" in messages
    assert "Traceback" not in messages, messages
    assert [p.name[:8] for p in out.iterdir()] == ["partial-"]
    experiment(load(), out, resume=True)
    assert contents(out) == expected
