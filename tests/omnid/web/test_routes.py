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
from omnid.transport.codec import DiagnosticStatus, PlanarPath, goal_from_cdr, string_from_cdr
from omnid.transport.status_names import NAVIGATION, WHEELS, Key
from omnid.transport.topics import Answer, Request, command_topics
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.omnid.web.servers import Shown, WebServer, served


class Navigator:
    """A robot that grants every request but those for the route `lost`, and whose disk is full at the second save."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self.asked, self.goals = bus, list[str](), list[PlanarPath]()
        self.twists: list[tuple[float, float]] = []
        self.state = "driving"
        bus.subscribe_commands(self._take, command_topics(("operator",)))

    def _take(self, request: Request) -> None:
        if request.topic == "cmd/twist":
            command = codec.twist_from_cdr(request.payload)
            self.twists.append((command.velocity_mps, command.yaw_rate_radps))
            return
        if request.topic == "cmd/goal":
            self.goals.append(goal_from_cdr(request.payload))
            self._bus.answer(request.id, Answer(True, "it drives there"))
            return
        text = string_from_cdr(request.payload)
        self.asked.append(text)
        is_refused = text.endswith("lost") or self.asked.count("save") == 2
        self._bus.answer(request.id, Answer(not is_refused, "that cannot be" if is_refused else f"does {text}"))

    def publish(self) -> None:
        """Report the navigation, and that it is armed."""
        wheels = DiagnosticStatus(WHEELS, 0, "driving", {Key.ARMED: "1"})
        self._bus.publish("status", codec.diagnostics_cdr(time.time_ns(), [wheels]))
        values = {Key.STATE: self.state, Key.REASON: "", Key.TASK: "route dock", Key.LEFT_M: "3.5"}
        entry = DiagnosticStatus(NAVIGATION, 0, "", {str(key): value for key, value in values.items()})
        self._bus.publish("navigation", codec.diagnostics_cdr(time.time_ns(), [entry]))


@pytest.fixture(scope="module")
def robot() -> Iterator[tuple[WebServer, Navigator]]:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, served("--connect", endpoint) as server:
        navigator = Navigator(bus)
        Shown(server).until("navigation", navigator.publish)
        yield server, navigator


def answer(robot: tuple[WebServer, Navigator], path: str, text: str) -> dict[str, Any]:
    """Return the answer to a request."""
    server, _ = robot
    found: dict[str, Any] = json.loads(server.request(path, "POST", server.bearer, text).text)
    return found


def test_requests_reach_the_robot_and_its_answer_the_page(robot: tuple[WebServer, Navigator]) -> None:
    server, navigator = robot
    for path, text, moves in (
        ("/route", "teach dock", False),
        ("/route", "finish", False),
        ("/route", "repeat dock", True),
        ("/route", "stop", False),
        ("/navigation", "pause", False),
        ("/navigation", "resume", True),
    ):
        stamp = f" stamp={server.state_ms()}" if moves else ""
        assert answer(robot, path, f"{text}{stamp}") == {"done": True, "text": f"does {text}"}
        assert navigator.asked[-1] == text
    refused = answer(robot, "/route", f"repeat lost stamp={server.state_ms()}")
    assert not refused["done"] and refused["text"] == "omnid refuses: that cannot be"
    shown = Shown(server).until("navigation", navigator.publish)
    assert (shown["state"], shown["task"], shown["left_m"]) == ("driving", "route dock", 3.5)
