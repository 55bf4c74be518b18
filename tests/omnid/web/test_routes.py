"""Routes from the page: passed on to the robot, answered by it, and refused where they are none."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.navigation_codec import string_from_cdr
from omnid.transport.status_names import MAP_FILE, NAVIGATION, Key
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.omnid.web.servers import PATIENCE_S, Shown, WebServer, served


class Navigator:
    """A robot that accepts every request but those for the route `lost`."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self.asked = bus, list[str]()
        bus.subscribe_commands(self._take, {})

    def _take(self, key: str, payload: bytes, *_: object) -> None:
        if key in ("cmd/route", "cmd/navigation", "cmd/map"):
            self.asked.append(string_from_cdr(payload))

    def publish(self) -> None:
        """Report the navigation, and the map's file: the second save finds nothing new, the third a full disk."""
        saves = self.asked.count("save")
        entry = DiagnosticStatus(MAP_FILE, 2 if saves == 3 else 0, "cannot write the map", {
            Key.SAVES: str(min(saves, 1)), Key.ANSWERED: str(saves)})
        self._bus.publish("status", codec.diagnostics_cdr(time.time_ns(), [entry]))
        newest = self.asked[-1] if self.asked else ""
        values = {Key.STATE: "driving", Key.REASON: "", Key.TASK: "route dock", Key.LEFT_M: "3.5",
                  Key.REQUEST_NUMBER: str(len(self.asked)), Key.REQUEST: newest,
                  Key.REFUSAL: "there is no such route" if newest.endswith("lost") else ""}
        entry = DiagnosticStatus(NAVIGATION, 0, "", {str(key): value for key, value in values.items()})
        self._bus.publish("navigation", codec.diagnostics_cdr(time.time_ns(), [entry]))


@pytest.fixture(scope="module")
def robot() -> Iterator[tuple[WebServer, Navigator]]:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, served("--connect", endpoint) as server:
        yield server, Navigator(bus)


def answer(robot: tuple[WebServer, Navigator], path: str, text: str) -> dict[str, Any]:
    """Return the answer to a request, while the robot reports its state."""
    server, navigator = robot
    with ThreadPoolExecutor(1) as thread:
        request = thread.submit(server.request, path, "POST", server.bearer, text)
        end_s = time.monotonic() + PATIENCE_S
        while not request.done() and time.monotonic() < end_s:
            navigator.publish()
            time.sleep(0.02)
    found: dict[str, Any] = json.loads(request.result().text)
    return found


def test_requests_reach_the_robot_and_its_answer_the_page(robot: tuple[WebServer, Navigator]) -> None:
    server, navigator = robot
    for path, text in (("/route", "teach dock"), ("/route", "finish"), ("/route", "repeat dock"), ("/route", "stop"),
                       ("/navigation", "pause"), ("/navigation", "resume")):
        assert answer(robot, path, text) == {"done": True, "text": "driving"}
        assert navigator.asked[-1] == text
    refused = answer(robot, "/route", "repeat lost")
    assert not refused["done"] and refused["text"].endswith("refuses: there is no such route")
    with server.live(server.bearer) as live:
        shown = Shown(live).until("navigation", navigator.publish)
    assert (shown["state"], shown["task"], shown["left_m"]) == ("driving", "route dock", 3.5)


def test_the_map_is_saved_when_it_is_asked_for(robot: tuple[WebServer, Navigator]) -> None:
    server, _ = robot
    assert answer(robot, "/map", "") == {"done": True, "text": "the map is saved"}
    assert answer(robot, "/map", "")["text"] == "the map in the file has all that is known already"
    refused = answer(robot, "/map", "x" * 100_000)
    assert not refused["done"] and refused["text"].endswith("cannot save its map: cannot write the map")
    assert server.request("/map", "POST").status == 403 and server.request("/map", headers=server.bearer).status == 405
    assert server.request("/map", "POST", {**server.bearer, "Origin": "http://evil.example"}).status == 403


@pytest.mark.parametrize(("path", "text"), [
    ("/route", ""), ("/route", "teach ../../etc/passwd"), ("/route", "repeat dock loops=-1"), ("/route", "x" * 5000),
    ("/navigation", "stop everything"), ("/navigation", "\x00\xff"),
])
def test_other_texts_never_leave_the_server(robot: tuple[WebServer, Navigator], path: str, text: str) -> None:
    server, navigator = robot
    before = len(navigator.asked)
    found = server.request(path, "POST", server.bearer, text)
    assert found.status == 409 and not json.loads(found.text)["done"] and len(navigator.asked) == before
    assert server.request(path, "POST", {"Origin": f"http://{server.host}"}, text).status == 401
    assert server.request(path, headers=server.bearer).status == 405
