"""Files of routes and the navigation: nothing waits for a disk, halts overtake, and a full disk loses no recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

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
from omnid.messages import NavigationUpdate
from omnid.navigation_state import NavigationState
from omnid.runs.route_files import Requests, RouteFiles, TaughtRoutes
from tests.omnid.stages.test_navigation import Robot

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
        self.direct, self.of_routes, self.taught = Queue(), Queue(), TaughtRoutes(self.requests)
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
            self.taught.process(self.robot.updates[-1])
        return self.robot.updates[-1]

    def work(self) -> NavigationUpdate:
        """Let the files and the stage do all that waits."""
        self.pass_on(self.of_routes)
        return self.pass_on(self.direct)

    def answers(self) -> dict[int, str]:
        """Return the refusals by the ids of the requests."""
        return {answer.id: answer.refusal for answer in self.robot.updates[-1].answers if answer.id}


def test_a_route_can_be_repeated_before_it_is_written_and_is_the_same_after(tmp_path: Path) -> None:
    site = Site(tmp_path)
    finish = site.ask(FINISH)
    again = site.ask(REPEAT)
    for _ in range(2):
        site.robot.take(site.robot.files.process(site.of_routes.waiting.pop(0)))  # finds no file yet
    update = site.robot.updates[-1]
    assert update.task == "route hall" and update.state is NavigationState.DRIVING and not update.teaching
    assert site.answers() == {again: ""}, "it is not written yet"
    assert update.taught is not None and not RouteFolder(tmp_path).names()
    site.taught.process(update)
    assert site.work().taught is None and site.answers() == {again: "", finish: ""}
    read = RouteFolder(tmp_path).read("hall")
    for name in ("poses", "speeds", "in_keyframe", "keyframes"):
        np.testing.assert_array_equal(getattr(read, name), getattr(update.taught.route, name))


def test_a_full_disk_loses_no_recording(tmp_path: Path) -> None:
    folder = tmp_path / "routes"
    folder.write_text("in the way")
    site = Site(folder)
    first = site.ask(FINISH)
    assert site.work().teaching == "hall" and "navigation.routes" in site.answers()[first]
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


def test_a_drive_that_has_begun_meanwhile_is_not_replaced_by_what_waited_for_a_disk(tmp_path: Path) -> None:
    site = Site(tmp_path)
    site.robot.send(FINISH)
    repeat, goal = site.ask(REPEAT), site.ask(GoalRequest(NavigationFrame.ODOM, 2.0, 0.0))
    site.pass_on(site.direct)
    assert site.pass_on(site.of_routes).task == "goal"
    assert site.answers()[goal] == "" and "a later request has ended it" in site.answers()[repeat]


@pytest.mark.hazard("H26")
def test_what_waits_for_a_disk_begins_nothing_after_a_stop_or_a_long_time(tmp_path: Path) -> None:
    site = Site(tmp_path)
    site.ask(FINISH)
    site.work()
    repeated = site.ask(REPEAT)
    site.robot.stage.process(WheelState(True, False, halts=1))  # a bumper; then it was armed again
    site.work()
    assert "a stop or a fault has come since" in site.answers()[repeated]
    again = site.ask(REPEAT, halts=1, asked_ns=1)
    assert site.work().state is not NavigationState.DRIVING
    assert "waited too long" in site.answers()[again]
    third = site.ask(REPEAT, halts=1)
    site.work()
    assert site.answers()[third] == ""


@pytest.mark.parametrize("replace", [False, True])
def test_an_existing_route_is_replaced_only_where_that_is_asked_for(tmp_path: Path, replace: bool) -> None:
    (tmp_path / "hall.route.json").write_text("damaged, but there")
    request = RouteRequest(RouteAction.TEACH, "hall", replace=replace)
    command = RouteFiles(RouteFolder(tmp_path)).process(NavigationCommand(request, 0))
    assert ("--replace" in command.refusal) is not replace
