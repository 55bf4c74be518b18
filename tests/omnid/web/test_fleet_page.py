"""`omnid web --all`: all robots behind a router, the page of one of them, and a stop for all."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from websockets.sync.client import connect

from omnid.core.control.safety_rules import ASKED
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import BUS, WHEELS
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint, odometry, script
from tests.omnid.web.servers import Shown, WebServer, served
from tests.replay.command import Command
from tests.waiting import PATIENCE_S

NAMES = ("hall/one", "two", "camera-only")
HOSTILE = "<img src=x onerror=alert(1)>\x1b[2J"


class Robots:
    """Robots that publish, and obey stops where they are told to."""

    def __init__(self, endpoint: str) -> None:
        self.buses = {name: Bus(BusConfig(robot=name, listen=(), connect=(endpoint,))) for name in NAMES}
        self.stops: dict[str, int] = dict.fromkeys(NAMES, 0)
        self.obeys = {"hall/one"}
        self._seq = 0
        for name, bus in self.buses.items():
            bus.subscribe_commands(lambda request, name=name: self._count(request.topic, name), {})

    def _count(self, key: str, name: str) -> None:
        self.stops[name] += key == "cmd/stop"

    def publish(self) -> None:
        self._seq += 1
        for name, bus in self.buses.items():
            pose = PoseAttachment(self._seq, "tracking", 0, 50, 60, time.time_ns()).to_bytes()
            bus.publish("odom", odometry(self._seq), pose)
            stopped = self.stops[name] > 1 and name in self.obeys
            wheels = DiagnosticStatus(
                WHEELS, 1, HOSTILE, {"armed": "0", "disarmed_by": ASKED} if stopped else {"armed": "1"}
            )
            entries = [DiagnosticStatus(BUS, 0, "open", {}), *([wheels] if name != "camera-only" else [])]
            bus.publish("status", codec.diagnostics_cdr(10**18, entries))


@pytest.fixture(scope="module")
def fleet() -> Iterator[tuple[WebServer, Robots]]:
    endpoint = free_endpoint()
    with contextlib.ExitStack() as ends:
        ends.enter_context(script(ROUTER, endpoint))
        robots = Robots(endpoint)
        for bus in robots.buses.values():
            ends.callback(bus.close)
        yield ends.enter_context(served("--all", "--connect", endpoint)), robots


def rows(fleet: tuple[WebServer, Robots]) -> dict[str, dict[str, Any]]:
    """Return the entries of all robots by name, once all are there with wheels and poses."""
    server, robots = fleet
    with server.live(server.bearer) as live:
        message = Shown(live).until(
            "fleet",
            robots.publish,
            lambda found: (
                len(found["robots"]) == len(NAMES)
                and all(
                    row["rate_hz"]
                    and row["x_m"] is not None
                    and (row["armed"] is not None or row["name"] == "camera-only")
                    for row in found["robots"]
                )
            ),
        )
    text = json.dumps(message)
    assert "onerror" in text and "\\u001b" not in text
    return {row["name"]: row for row in message["robots"]}


def test_all_robots_are_listed(fleet: tuple[WebServer, Robots]) -> None:
    found = rows(fleet)
    assert set(found) == set(NAMES)
    assert found["two"]["state"] == "tracking" and found["two"]["level"] == 1 and found["two"]["armed"]
    assert found["camera-only"]["armed"] is None and found["camera-only"]["level"] == 0
    server, _ = fleet
    metrics = server.request("/metrics", headers=server.bearer).text
    assert 'omnid_up{robot="hall/one"} 1' in metrics and "onerror" not in metrics


def test_each_robot_has_its_page(fleet: tuple[WebServer, Robots]) -> None:
    server, robots = fleet
    key = rows(fleet)["two"]["key"]
    assert "page.js" in server.request(f"/robot/{key}/", headers=server.bearer).text
    with connect(f"ws://{server.host}/robot/{key}/live", additional_headers=server.bearer, compression=None) as live:
        state = Shown(live).until("state", robots.publish, lambda found: found["pose"] and found["wheels"])
    assert state["robot"] == "two" and state["wheels"]["armed"]


@pytest.mark.parametrize("path", ["/robot/0/", "/robot/hall/one/", "/robot/../login/", "/robot/", "/recordings"])
def test_other_pages_are_not_there(fleet: tuple[WebServer, Robots], path: str) -> None:
    server, _ = fleet
    assert server.request(path, headers=server.bearer).status == 404
    assert server.request(path).status == 401


def test_a_stop_reaches_all_and_names_those_that_do_not_confirm(fleet: tuple[WebServer, Robots]) -> None:
    server, robots = fleet
    rows(fleet)
    assert server.request("/stop", "POST", {**server.cookie(), "Origin": "http://evil.example"}).status == 403
    assert server.request("/stop", "POST").status in (401, 403)
    assert sum(robots.stops.values()) == 0
    with ThreadPoolExecutor(1) as thread:
        answer = thread.submit(server.post, "/stop")
        end_s = time.monotonic() + PATIENCE_S
        while not answer.done() and time.monotonic() < end_s:
            robots.publish()
            if min(robots.stops["two"], 12) == 12:  # it obeys late
                robots.obeys.add("two")
            time.sleep(0.02)
    assert answer.result() == {"done": True, "text": "all 2 robots stop: their wheels stand until they are armed"}
    assert robots.stops["two"] >= 12 > robots.stops["hall/one"] and robots.stops["camera-only"] == 1


def test_a_robot_is_not_named_beside_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert "--robot" in Command(capsys).refused("web", "--listen", "127.0.0.1:0", "--all", "--robot", "two")
