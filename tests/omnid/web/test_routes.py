"""Routes from the page: passed on to the robot, answered by it, and refused where they are none."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from typing import Any

import pytest

from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.navigation_codec import string_from_cdr
from omnid.transport.requests import Answer, Request
from omnid.transport.status_names import NAVIGATION, Key
from omnid.transport.topics import command_topics
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.omnid.web.servers import Shown, WebServer, served


class Navigator:
    """A robot that grants every request but those for the route `lost`, and whose disk is full at the second save."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self.asked = bus, list[str]()
        bus.subscribe_commands(self._take, command_topics(("operator",)))

    def _take(self, request: Request) -> None:
        text = string_from_cdr(request.payload)
        self.asked.append(text)
        is_refused = text.endswith("lost") or self.asked.count("save") == 2
        self._bus.answer(request.id, Answer(not is_refused, "that cannot be" if is_refused else f"does {text}"))

    def publish(self) -> None:
        """Report the navigation."""
        values = {Key.STATE: "driving", Key.REASON: "", Key.TASK: "route dock", Key.LEFT_M: "3.5"}
        entry = DiagnosticStatus(NAVIGATION, 0, "", {str(key): value for key, value in values.items()})
        self._bus.publish("navigation", codec.diagnostics_cdr(time.time_ns(), [entry]))


@pytest.fixture(scope="module")
def robot() -> Iterator[tuple[WebServer, Navigator]]:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, served("--connect", endpoint) as server:
        navigator = Navigator(bus)
        with server.live(server.bearer) as live:
            Shown(live).until("navigation", navigator.publish)
        yield server, navigator


def answer(robot: tuple[WebServer, Navigator], path: str, text: str) -> dict[str, Any]:
    """Return the answer to a request."""
    server, _ = robot
    found: dict[str, Any] = json.loads(server.request(path, "POST", server.bearer, text).text)
    return found


def test_requests_reach_the_robot_and_its_answer_the_page(robot: tuple[WebServer, Navigator]) -> None:
    server, navigator = robot
    for path, text in (("/route", "teach dock"), ("/route", "finish"), ("/route", "repeat dock"), ("/route", "stop"),
                       ("/navigation", "pause"), ("/navigation", "resume")):
        assert answer(robot, path, text) == {"done": True, "text": f"does {text}"}
        assert navigator.asked[-1] == text
    refused = answer(robot, "/route", "repeat lost")
    assert not refused["done"] and refused["text"] == "omnid refuses: that cannot be"
    with server.live(server.bearer) as live:
        shown = Shown(live).until("navigation", navigator.publish)
    assert (shown["state"], shown["task"], shown["left_m"]) == ("driving", "route dock", 3.5)


def test_the_map_is_saved_when_it_is_asked_for(robot: tuple[WebServer, Navigator]) -> None:
    server, _ = robot
    assert answer(robot, "/map", "") == {"done": True, "text": "does save"}
    assert answer(robot, "/map", "x" * 100_000) == {"done": False, "text": "omnid refuses: that cannot be"}
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
