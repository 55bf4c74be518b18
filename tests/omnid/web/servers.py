"""`omnid web` in a process of its own, and a client that sends what browsers send, and what they never would."""

from __future__ import annotations

import http.client
import json
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

from tests.waiting import OMNID, PATIENCE_S, ended, running


class HttpAnswer(NamedTuple):
    """Answer to a request."""

    status: int
    headers: Mapping[str, str]
    text: str


class WebServer:
    """A running `omnid web`."""

    def __init__(self, process: subprocess.Popen[str], url: str) -> None:
        self.process, self.url = process, url
        parts = urlsplit(url)
        self.port = int(parts.port or 0)
        self.host = f"127.0.0.1:{self.port}"
        self.token = parse_qs(parts.query)["token"][0]

    @property
    def bearer(self) -> dict[str, str]:
        """The header of a program that knows the token."""
        return {"Authorization": f"Bearer {self.token}"}

    def request(
        self, path: str, method: str = "GET", headers: Mapping[str, str] | None = None, body: str | None = None
    ) -> HttpAnswer:
        """Send one request over a connection of its own."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            connection.request(method, path, body, dict(headers or {}))
            answer = connection.getresponse()
            return HttpAnswer(
                answer.status,
                {name.lower(): value for name, value in answer.getheaders()},
                answer.read().decode("utf-8", "replace"),
            )
        finally:
            connection.close()

    def post(self, path: str, body: str | None = None) -> dict[str, Any]:
        """Send a command as a program; return the answer."""
        found: dict[str, Any] = json.loads(self.request(path, "POST", self.bearer, body).text)
        return found

    def arm(self) -> dict[str, Any]:
        """Ask for arming, as a page that shows the newest state; return the answer."""
        return self.post("/arm", str(self.state_ms()))

    def state_ms(self) -> int:
        """Return the server's time in the newest state, as a page knows it."""
        return int(Shown(self).until("state")["server_ms"])

    def cookie(self) -> dict[str, str]:
        """Return the header of a browser that has opened the printed address."""
        answer = self.request(f"/?token={self.token}")
        assert answer.status == 303 and answer.headers["location"] == "/"
        return {"Cookie": answer.headers["set-cookie"].split(";")[0]}

    def image(self, kind: str) -> bytes:
        """Return the cells of the map, as they are sent, or the panorama."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            connection.request("GET", f"/image/{kind}", headers=self.bearer)
            return connection.getresponse().read()
        finally:
            connection.close()

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Send a signal; return the exit code and stderr."""
        return ended(self.process, number)


@contextmanager
def served(*words: object) -> Iterator[WebServer]:
    """Yield a server on a free port; it is killed at the end of the block."""
    with running([*OMNID, "web", "--listen", "127.0.0.1:0", *words]) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, process.communicate()[1]
        yield WebServer(process, line.strip())


class Shown:
    """Content of a page: the newest value of each kind, asked for as the page does."""

    def __init__(self, server: WebServer) -> None:
        self._server, self._seen = server, 0
        self.newest: dict[str, Any] = {}

    def read(self) -> None:
        """Receive what is new since the last call."""
        answer = self._server.request(f"/live?seen={self._seen}", headers=self._server.bearer)
        assert answer.status == 200, answer.text
        values = json.loads(answer.text)
        self._seen = values.pop("seen")
        self.newest |= values

    def until(
        self, kind: str, action: Callable[[], object] = lambda: None, holds: Callable[[Any], object] = lambda _: True
    ) -> Any:
        """Repeat an action and read until a value of a kind is there for which a condition holds; return it."""
        end_s = time.monotonic() + PATIENCE_S
        while kind not in self.newest or not holds(self.newest[kind]):
            assert time.monotonic() < end_s, f"no such {kind!r} within {PATIENCE_S:g} s: {self.newest}"
            action()
            self.read()
        return self.newest[kind]
