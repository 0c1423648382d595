"""A page that shows a live run in a browser, from a small server on this machine.

The server subscribes to what a live run publishes, and passes it on as server-sent events, at most `FRAMES_PER_S`
pictures per second. It answers only those who know the token of its address.
"""

import http.server
import json
import queue
import secrets
import threading
import time
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

from stereophd.errors import InputError
from stereophd.io.streams.sources import connect

PAGE = "live.html"
# Pictures per second, and those that wait for a slow browser before it misses some.
FRAMES_PER_S, MOST_WAITING = 20.0, 100


class _Server(http.server.ThreadingHTTPServer):
    """Serves the page, and the messages to every open page."""

    daemon_threads = True

    def __init__(self, host: str, port: int) -> None:
        super().__init__((host, port), _Handler)
        self.token = secrets.token_urlsafe(16)
        self._readers: set[queue.Queue[bytes]] = set()
        self._kept: dict[str, bytes] = {}

    def pass_on(self, message: bytes) -> None:
        """Send a message to all pages; a page that opens later gets the last event of each kind."""
        event = json.loads(message).get("event")
        if event is not None:
            self._kept[event] = message
        for reader in list(self._readers):
            if reader.qsize() < MOST_WAITING:
                reader.put(message)

    def open_reader(self) -> queue.Queue[bytes]:
        """Return the messages of a page from now on."""
        reader: queue.Queue[bytes] = queue.Queue()
        for message in list(self._kept.values()):
            reader.put(message)
        self._readers.add(reader)
        return reader

    def close_reader(self, reader: queue.Queue[bytes]) -> None:
        """Forget a page."""
        self._readers.discard(reader)


class _Handler(http.server.BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        """Answer a request for the page, or for its events."""
        address = urlsplit(self.path)
        token = parse_qs(address.query).get("token", [""])[0]
        if not secrets.compare_digest(token.encode(), self.server.token.encode()):
            self.send_error(403, "the address needs its token")
        elif address.path == "/":
            self._answer("text/html; charset=utf-8")
            self.wfile.write(files("stereophd.report.page").joinpath(PAGE).read_bytes())
        elif address.path == "/events":
            self._answer("text/event-stream")
            self._send_events()
        else:
            self.send_error(404)

    def _answer(self, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()

    def _send_events(self) -> None:
        reader = self.server.open_reader()
        try:
            while True:
                self.wfile.write(b"data: " + reader.get() + b"\n\n")
                self.wfile.flush()
        except OSError:  # the page was closed
            pass
        finally:
            self.server.close_reader(reader)

    def log_message(self, format: str, *args: Any) -> None:
        """Write nothing: an address in a log would show the token."""


class Watch:
    """A server of the page of a live run at an address; ends with the block. Raises InputError if it cannot be."""

    def __init__(self, address: str, host: str = "127.0.0.1", port: int = 0) -> None:
        self._socket = connect(address)
        try:
            self._server = _Server(host, port)
        except OSError as error:
            raise InputError(f"{host}:{port}: cannot be served: {error.strerror or error}") from error
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        """The address for a browser, with the token."""
        host, port = self._server.server_address[:2]
        return f"http://{host!s}:{port}/?token={self._server.token}"

    def run(self, until_s: float = float("inf")) -> None:
        """Pass messages on until an interrupt, or a time of `time.monotonic`."""
        sent_s = 0.0
        while time.monotonic() < until_s:
            if not self._socket.poll(100):
                continue
            message = self._socket.recv()
            is_event = message.startswith(b'{"event"')
            if is_event or time.monotonic() > sent_s + 1.0 / FRAMES_PER_S:
                sent_s = sent_s if is_event else time.monotonic()
                self._server.pass_on(message)

    def close(self) -> None:
        """End the server."""
        self._server.shutdown()
        self._server.server_close()
        self._socket.close(0)
