"""Files of routes and the stage: nothing waits for a disk, halts overtake, and a full disk loses no recording."""

from __future__ import annotations

from collections.abc import Callable
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
from omnid.core.navigation.route import Route
from omnid.formats.route_file import RouteFolder
from omnid.messages import NavigationUpdate
from omnid.navigation_state import NavigationState
from omnid.runs import route_files
from omnid.runs.route_files import RouteFiles
from omnid.transport.topics import MOST_OPEN
from tests.omnid.stages.test_navigation import Robot

TEACH, FINISH = RouteRequest(RouteAction.TEACH, "hall"), RouteRequest(RouteAction.FINISH)
REPEAT = RouteRequest(RouteAction.REPEAT, "hall")


class Site:
    """A robot whose route is being taught; messages go from files to stage and back when the test says so."""

    def __init__(self, folder: Path) -> None:
        self.robot = Robot(folder)
        self.files, self.asked, self.id = self.robot.files, self.robot.asked, 0
        self.robot.pass_on()
        self.robot.send(TEACH)
        for _ in range(30):
            self.robot.velocity = np.array([0.3, 0.0])
            self.robot.pass_on()
        self.robot.velocity = np.zeros(2)
        self.robot.pass_on()

    def ask(self, request: NavigationRequest) -> int:
        """Send a request; return its id."""
        self.id += 1
        self.files.put(NavigationCommand(request, 1_800_000_000 * 10**9, id=self.id))
        return self.id

    def work(self) -> NavigationUpdate:
        """Let the stage take what has reached it; return its newest update."""
        while self.asked:
            update = self.robot.stage.process(self.asked.pop(0))
            assert update is not None
            self.newest = update
        return self.newest

    def answers(self) -> dict[int, str]:
        """Return the refusals by the ids of the requests."""
        return {answer.id: answer.refusal for answer in self.newest.answers if answer.id}


def test_a_route_can_be_repeated_before_it_is_written_and_is_the_same_after(tmp_path: Path) -> None:
    site = Site(tmp_path)
    finish, again = site.ask(FINISH), site.ask(REPEAT)
    site.files()  # finds no file yet
    update = site.work()
    assert update.task == "route hall" and update.state is NavigationState.DRIVING and not update.teaching
    assert site.answers() == {again: ""}, "it is not written yet"
    assert update.taught is not None and not RouteFolder(tmp_path).names()
    site.files.process(update)
    site.files()
    site.files()
    assert len(site.asked) == 1 and site.robot.places.saves == 1, "it is written once, and the map with it"
    assert site.work().taught is None and site.answers() == {again: "", finish: ""}
    read = RouteFolder(tmp_path).read("hall")
    for name in ("poses", "speeds", "in_keyframe", "keyframes"):
        np.testing.assert_array_equal(getattr(read, name), getattr(update.taught.route, name))


def test_a_full_disk_loses_no_recording(tmp_path: Path) -> None:
    folder = tmp_path / "routes"
    folder.write_text("in the way")
    site = Site(folder)
    first = site.ask(FINISH)
    site.files.process(site.work())
    site.files()
    assert site.work().teaching == "hall" and "navigation.routes" in site.answers()[first]
    assert site.robot.places.saves == 0
    folder.unlink()
    second = site.ask(FINISH)
    site.files.process(site.work())
    site.files()
    assert not site.work().teaching and site.answers()[second] == "" and RouteFolder(folder).names() == ["hall"]


class SlowFolder(RouteFolder):
    """A disk that takes so long to read that requests come meanwhile."""

    meanwhile: Callable[[], object]

    def read(self, name: str) -> Route:
        self.meanwhile()
        return super().read(name)


@pytest.mark.hazard("H50")
def test_a_halt_overtakes_what_waits_for_a_disk_and_ends_it(tmp_path: Path) -> None:
    site = Site(tmp_path)
    site.robot.send(FINISH)
    folder = site.files._folder = SlowFolder(tmp_path)
    ids: list[int] = []

    def cancel() -> None:
        ids.extend((site.ask(GoalRequest(NavigationFrame.ODOM, 2.0, 0.0)), site.ask(NavigationVerb.CANCEL)))
        assert [command.request for command in site.asked] == [NavigationVerb.CANCEL], "nothing else overtakes"

    folder.meanwhile = cancel
    repeat = site.ask(REPEAT)
    site.files()
    update = site.work()
    goal, halt = ids
    assert update.state is not NavigationState.DRIVING and (update.setpoint is None or not update.setpoint.velocity_mps)
    refusals = site.answers()
    assert refusals[halt] == "" and all("a later request has ended it" in refusals[id] for id in (repeat, goal))
    folder.meanwhile = lambda: None
    site.ask(REPEAT)
    site.files()
    assert site.work().state is NavigationState.DRIVING, "a request after the halt is granted"


@pytest.mark.hazard("H26")
def test_what_waits_for_a_disk_begins_nothing_after_a_stop_or_a_long_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, halts = Site(tmp_path), list[str]()
    monkeypatch.setattr(site.files, "_halts", lambda: len(halts))
    site.ask(FINISH)
    site.work()
    site.files()
    repeated = site.ask(REPEAT)
    halts.append("a bumper")
    site.files()
    site.work()
    assert "a stop or a fault has come since" in site.answers()[repeated]
    monkeypatch.setattr(route_files, "LONGEST_WAIT_S", -1.0)
    again = site.ask(REPEAT)
    site.files()
    assert site.work().state is not NavigationState.DRIVING
    assert "waited too long" in site.answers()[again]
    monkeypatch.setattr(route_files, "LONGEST_WAIT_S", 5.0)
    third = site.ask(REPEAT)
    site.files()
    site.work()
    assert site.answers()[third] == ""


def test_requests_that_wait_for_a_disk_are_bounded(tmp_path: Path) -> None:
    passed: list[NavigationCommand] = []
    files = RouteFiles(RouteFolder(tmp_path), passed.append)
    for id in range(MOST_OPEN + 3):
        files.put(NavigationCommand(REPEAT, 0, id=id))
    assert [command.id for command in passed] == list(range(MOST_OPEN, MOST_OPEN + 3))
    assert all("ask again" in command.refusal for command in passed)
    files()
    assert len(passed) == MOST_OPEN + 3 and "no route hall" in passed[-1].refusal


@pytest.mark.parametrize("replace", [False, True])
def test_an_existing_route_is_replaced_only_where_that_is_asked_for(tmp_path: Path, replace: bool) -> None:
    (tmp_path / "hall.route.json").write_text("damaged, but there")
    passed: list[NavigationCommand] = []
    files = RouteFiles(RouteFolder(tmp_path), passed.append)
    files.put(NavigationCommand(RouteRequest(RouteAction.TEACH, "hall", replace=replace), 0))
    files()
    assert ("--replace" in passed[0].refusal) is not replace
