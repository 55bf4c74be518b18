"""Routes are taught, written and repeated: nothing waits for a disk, halts overtake, a full one loses no recording."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from omnid.core.navigation.follower import STAND
from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationCommand,
    NavigationFrame,
    NavigationRequest,
    NavigationVerb,
    RouteAction,
    RouteRequest,
)
from omnid.core.navigation.situation import WheelState
from omnid.engine.graph import Graph
from omnid.formats.route_file import RouteFolder
from omnid.messages import NavigationUpdate, PlaceUpdate
from omnid.navigation_state import NavigationState
from omnid.runs.route_files import Requests
from omnid.tracking_state import MapState
from omnid.transport.topics import Answer
from tests.omnid.stages.test_navigation import (
    ODOM,
    PERIOD_NS,
    UNIT,
    Robot,
)


@pytest.mark.hazard("H29")
def test_a_route_is_taught_and_repeated(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.pass_on()
    robot.send(RouteRequest(RouteAction.TEACH, "hall"))
    for k in range(150):
        robot.velocity = np.array([0.3, 0.4 * math.sin(k / 20)])
        robot.pass_on()
    robot.velocity = np.zeros(2)
    update = robot.pass_on()
    assert robot.updates[-1].teaching == "hall" and robot.updates[-1].taught_m == pytest.approx(4.5, abs=0.2)
    update = robot.send(RouteRequest(RouteAction.FINISH))
    assert robot.written[0] == Answer(True, "the route is written") and not update.teaching
    update = robot.send(RouteRequest(RouteAction.TEACH, "hall"))
    assert update.answer is not None and "there is a route hall already" in update.answer.refusal
    assert robot.send(RouteRequest(RouteAction.TEACH, "hall", replace=True)).teaching == "hall"
    assert "is being taught" in (robot.send(RouteRequest(RouteAction.REPEAT, "hall")).answer or ("",) * 3)[2]
    robot.send(RouteRequest(RouteAction.STOP))  # so that the old one stays
    end = robot.pose.copy()
    robot.send(RouteRequest(RouteAction.REPEAT, "hall", reverse=True))
    assert robot.updates[-1].task == "route hall"
    assert robot.run(1200).state is NavigationState.REACHED
    assert math.hypot(*robot.pose[:2]) < 0.1
    robot.send(RouteRequest(RouteAction.REPEAT, "hall"))
    assert robot.run(1200).state is NavigationState.REACHED
    np.testing.assert_allclose(robot.pose[:2], end[:2], atol=0.1)
    other = Robot(tmp_path, stamp_ns=6)
    other.pass_on()
    update = other.send(RouteRequest(RouteAction.REPEAT, "hall"))
    assert update.answer is not None and "in the map site.omap as it was then" in update.answer.refusal
    other.stage.map_name = ""
    update = other.send(RouteRequest(RouteAction.TEACH, "x"))
    assert update.answer is not None and "--map FILE.omap" in update.answer.refusal


def test_a_route_is_taught_in_a_new_map_while_nothing_is_recognised_yet(tmp_path: Path) -> None:
    for is_new in (True, False):
        robot = Robot(tmp_path, is_new=is_new)
        robot.map_state = MapState.ODOMETRY_ONLY
        robot.pass_on()
        answer = robot.send(RouteRequest(RouteAction.TEACH, "hall")).answer
        assert answer is not None and answer.refusal.startswith("" if is_new else "not localised in a map")
        robot.send(GoalRequest(ODOM, 1.5, 0.0))
        robot.run()
        assert robot.updates[-1].teaching == ("hall" if is_new else "")
        if is_new:
            robot.resets = 1
            robot.pass_on()
            robot.pass_on()  # with the first place in the new odom
            answer = robot.updates[-1].answer
            assert answer is not None and "teach it again" in answer.refusal and not robot.updates[-1].teaching
            assert "not localised" in robot.send(RouteRequest(RouteAction.TEACH, "hall")).answer.refusal


@pytest.mark.hazard("H28")
def test_after_a_reset_a_place_from_before_it_is_none(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.pass_on()
    robot.send(GoalRequest(NavigationFrame.MAP, 5.0, 0.0))
    robot.pass_on()
    assert robot.updates[-1].state is NavigationState.DRIVING
    robot.resets, robot.in_map = 1, False
    for _ in range(3):
        robot.pass_on()
    assert robot.updates[-1].state is NavigationState.NOT_LOCALISED and robot.updates[-1].setpoint == STAND
    late = PlaceUpdate(1, PERIOD_NS, np.eye(4), np.eye(4), UNIT, MapState.LOCALIZED, 3, np.eye(4))
    robot.stage.process(late)
    answer = robot.send(GoalRequest(NavigationFrame.MAP, 1.0, 0.0)).answer
    assert answer is not None and answer.refusal.startswith("not localised in a map")


TEACH, FINISH = RouteRequest(RouteAction.TEACH, "hall"), RouteRequest(RouteAction.FINISH)
REPEAT = RouteRequest(RouteAction.REPEAT, "hall", reverse=True)  # the robot stands at its end


class Queue:
    """A sink that keeps what waits for a thread."""

    def __init__(self) -> None:
        self.waiting: list[NavigationCommand] = []

    def process(self, command: NavigationCommand) -> None:
        self.waiting.append(command)


class Site:
    """A robot whose route is being taught; requests wait for the files, or for the stage, until the test says so."""

    def __init__(self, folder: Path) -> None:
        graph = Graph(threaded=False)
        self.robot, self.requests, self.id = Robot(folder), Requests(graph), 0
        self.direct, self.of_routes = Queue(), Queue()
        graph.sink("direct", self.direct, self.requests.direct)
        graph.sink("of-routes", self.of_routes, self.requests.of_routes)
        self.robot.pass_on()
        self.robot.send(TEACH)
        for _ in range(30):
            self.robot.velocity = np.array([0.3, 0.0])
            self.robot.pass_on()
        self.robot.velocity = np.zeros(2)
        self.robot.pass_on()

    def ask(self, request: NavigationRequest, **values: int) -> int:
        """Send a request; return its id."""
        self.id += 1
        self.requests.put(NavigationCommand(request, 1_800_000_000 * 10**9, id=self.id, **values))
        return self.id

    def pass_on(self, queue: Queue) -> NavigationUpdate:
        """Let the stage take what has reached it, by way of the files or directly; return its newest update."""
        while queue.waiting:
            command = queue.waiting.pop(0)
            self.robot.take(self.robot.files.process(command) if queue is self.of_routes else command)
        return self.robot.updates[-1]

    def work(self) -> NavigationUpdate:
        """Let the files and the stage do all that waits."""
        self.pass_on(self.of_routes)
        return self.pass_on(self.direct)

    def answers(self) -> dict[int, str]:
        """Return the refusals by the ids of the requests."""
        written = {id: "" if answer.done else answer.text for id, answer in self.robot.written.items()}
        return written | {answer.id: answer.refusal for answer in self.robot.updates[-1].answers if answer.id}


def test_a_full_disk_loses_no_recording(tmp_path: Path) -> None:
    folder = tmp_path / "routes"
    folder.write_text("in the way")
    site = Site(folder)
    first = site.ask(FINISH)
    site.work()
    assert "navigation.routes" in site.answers()[first]
    folder.unlink()
    second = site.ask(FINISH)
    assert not site.work().teaching and site.answers()[second] == "" and RouteFolder(folder).names() == ["hall"]


@pytest.mark.hazard("H50")
def test_a_halt_overtakes_what_waits_for_a_disk_and_ends_it(tmp_path: Path) -> None:
    site = Site(tmp_path)
    site.robot.send(FINISH)
    repeat, halt = site.ask(REPEAT), site.ask(NavigationVerb.CANCEL)
    site.pass_on(site.direct)
    update = site.pass_on(site.of_routes)
    assert update.state is not NavigationState.DRIVING and (update.setpoint is None or not update.setpoint.velocity_mps)
    assert site.answers()[halt] == "" and "a later request has ended it" in site.answers()[repeat]
    site.ask(REPEAT)
    assert site.work().state is NavigationState.DRIVING, "a request after the halt is granted"


@pytest.mark.hazard("H26")
def test_what_waits_for_a_disk_begins_nothing_after_a_stop_or_a_long_time(tmp_path: Path) -> None:
    site = Site(tmp_path)
    site.ask(FINISH)
    site.work()
    repeated = site.ask(REPEAT)
    site.robot.stage.process(WheelState(True, False, stop_count=1))  # a bumper; then it was armed again
    site.work()
    assert "a stop or a fault has come since" in site.answers()[repeated]
    again = site.ask(REPEAT, stop_count=1, asked_ns=1)
    assert site.work().state is not NavigationState.DRIVING
    assert "waited too long" in site.answers()[again]
    third = site.ask(REPEAT, stop_count=1)
    site.work()
    assert site.answers()[third] == ""
