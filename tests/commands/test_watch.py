"""The page of a live run: it draws what a publisher sends, and only for those who know the token."""

from __future__ import annotations

import http.client
import json
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import pytest

from stereophd.commands.watch import PAGE, Watch
from stereophd.io.streams.documents import CameraPlace, Ready, RecordDocument
from stereophd.io.streams.rows import Publisher

pytest.importorskip("zmq")
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CAMERAS = [
    {"name": "left", "center": [-1.0, 0.0, 0.0], "looks_along": [0.0, 0.0, 1.0]},
    {"name": "right", "center": [1.0, 0.0, 0.0], "looks_along": [0.0, 0.0, 1.0]},
]


def document(number: int) -> dict[str, Any]:
    track = {"track_id": 3, "x": 0.01 * number, "y": 0.0, "z": 5.0, "status": "confirmed"}
    track |= {"vx": 0.0, "vy": 0.0, "vz": 0.0, "position_covariance": [1.0] * 6, "existence": 1.0}
    return {"time_s": 0.1 * number, "camera": "left", "frame": number, "revised": False, "tracks": [track]}


@pytest.fixture
def watch() -> Iterator[Watch]:
    """A page of a run that goes on until the end of the test."""
    publisher, is_over = Publisher("tcp://127.0.0.1:*"), threading.Event()
    watching = Watch(publisher.address)

    def publish() -> None:
        publisher.tell(Ready([CameraPlace(**camera) for camera in CAMERAS]))
        number = 0
        while not is_over.wait(0.05):
            publisher.add(msgspec.convert(document(number), RecordDocument))
            if number % 5 == 0:
                publisher.tell(Ready([CameraPlace(**camera) for camera in CAMERAS]))
            number += 1

    threads = [
        threading.Thread(target=publish),
        threading.Thread(target=watching.run, args=(time.monotonic() + 10.0,)),
    ]
    for thread in threads:
        thread.daemon = True
        thread.start()
    yield watching
    is_over.set()


def answer(watch: Watch, path: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(urlsplit(watch.url).netloc, timeout=10)
    connection.request("GET", path)
    response = connection.getresponse()
    return response.status, response.read(200) if response.status == 200 else b""


def test_only_the_token_opens_the_page(watch: Watch) -> None:
    address = urlsplit(watch.url)
    assert address.hostname == "127.0.0.1"
    assert answer(watch, "/")[0] == answer(watch, "/events?token=wrong")[0] == 403
    assert answer(watch, f"/nothing?{address.query}")[0] == 404
    assert answer(watch, f"/?{address.query}")[1].startswith(b"<!doctype html>")
    status, content = answer(watch, f"/events?{address.query}")
    assert status == 200
    assert content.startswith(b"data: {")


@pytest.mark.skipif(BROWSER is None, reason="no chromium or chrome is installed")
def test_a_browser_draws_what_is_published(tmp_path: Path) -> None:
    knocked = {"event": "knocked", "camera": "right", "time_s": 2.0, "turn_deg": 1.5}
    messages = json.dumps([{"event": "ready", "cameras": CAMERAS}, *map(document, range(30)), knocked])
    # messages that come at once: a connection that stays open would hold up the browser's clock
    taken = f"for (const m of {messages}) take({{data: JSON.stringify(m)}})"
    source = f"class EventSource {{ set onmessage(take) {{ {taken} }} }}"
    page = files("stereophd.report.page").joinpath(PAGE).read_text(encoding="utf-8")
    (tmp_path / "page.html").write_text(page.replace("<script>", f"<script>{source}</script><script>", 1))
    command = [
        str(BROWSER), "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu",
        f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=2000", "--dump-dom",
        (tmp_path / "page.html").as_uri(),
    ]  # fmt: skip
    drawn = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False).stdout
    assert "<td>tracks</td><td>1</td>" in drawn
    assert "<td>left</td><td>29</td><td>0.00 s</td>" in drawn
    assert '<td class="warning">knocked</td>' in drawn
    assert "right knocked 1.50 degrees" in drawn
