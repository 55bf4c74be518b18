"""Navigation stage: requests are answered, frames are those of the base, routes are taught and repeated."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib import se3
from calib.se2_arrays import planar, transform
from omnid.core.control.collision_monitor import UNKNOWN, CollisionSettings
from omnid.core.control.control_law import ControllerState
from omnid.core.mapping.range_scan import RangeScan
from omnid.core.navigation.follower import STANDSTILL
from omnid.core.navigation.navigator import CROSSES
from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationCommand,
    NavigationFrame,
    NavigationRequest,
    NavigationState,
    NavigationVerb,
    PathRequest,
    RouteAction,
    RouteRequest,
)
from omnid.core.navigation.route import Route
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.obstacles.moving_tracker import MovingObstacle
from omnid.formats.route_file import RouteFolder
from omnid.messages import MapKeyframes, NavigationUpdate, ObstacleScan, OdometryUpdate, PlaceUpdate
from omnid.runs.files import RouteFiles
from omnid.sinks.drive import navigation_answers
from omnid.stages.navigation import NavigationStage
from omnid.tracking_state import MapState, TrackingState
from omnid.transport.topics import Answer
from tests.omnid.core.navigation.driven_base import ARMED, Floor

T_BASE_RIG = se3.transform(se3.rotation_exp([0.0, 0.0, 0.5]), [0.1, -0.2, 0.9])
T_MAP_ODOM = transform(np.array([2.0, -1.0, 0.3]))  # of the base's frames
PERIOD_NS = 100_000_000
ODOM, MAP = NavigationFrame.ODOM, NavigationFrame.MAP
DEPTH: Any = None  # the stage reads none
UNIT = np.eye(6) * 1e-6


def fixed_map(
    settings: NavigationSettings,
    collision: CollisionSettings,
    T_base_rig: np.ndarray,
    stamp_ns: int = 5,
    *,
    routes: dict[str, Route] | None = None,
    is_new: bool = False,
) -> NavigationStage:
    """Return a stage in a map with one keyframe, which is never moved."""
    routes = {} if routes is None else routes
    stage = NavigationStage(settings, collision, T_base_rig, np.eye(4), "site.omap", routes, is_new=is_new)
    stage.keyframes = MapKeyframes({3: stamp_ns}, {3: np.eye(4)})
    return stage


class Robot:
    """A base that follows setpoints exactly, seen through the stage's messages."""

    def __init__(self, folder: Path, **of_map: Any) -> None:
        self.files = RouteFiles(RouteFolder(folder))
        of_map = {"routes": self.files.routes, **of_map}
        self.stage = fixed_map(NavigationSettings(), CollisionSettings(), T_BASE_RIG, **of_map)
        self.stage.process(ARMED)
        self.answers: dict[int, Answer] = {}  # to requests
        self.pose, self.velocity = np.zeros(3), np.zeros(2)
        self.seq = 0
        self.updates: list[NavigationUpdate] = []
        self.map_state, self.resets = MapState.LOCALIZED, 0
        self.in_map = True

    def send(self, request: NavigationRequest, stamp_ns: int = 0, id: int = 0, stops: int = 0) -> NavigationUpdate:
        """Return the state after a request, which was sent after so many stops, and keep the answers."""
        update = self.stage.process(NavigationCommand(request, 1_800_000_000 * 10**9, stamp_ns, id, stops))
        assert update is not None
        self.updates.append(update)
        self.answers |= navigation_answers(update) or {}
        self.answers |= self.files.write(update) or {}
        return update

    def pass_on(self) -> NavigationUpdate | None:
        """Advance by a period."""
        self.seq += 1
        T_odom_base = transform(self.pose)
        T_odom_rig = se3.inverse(T_BASE_RIG) @ T_odom_base @ T_BASE_RIG
        to_rig = se3.adjoint(se3.inverse(T_BASE_RIG))
        velocity = to_rig @ np.array([self.velocity[0], 0, 0, 0, 0, self.velocity[1]])
        stamp_ns = self.seq * PERIOD_NS
        if self.in_map:
            T_map_odom = se3.inverse(T_BASE_RIG) @ T_MAP_ODOM @ T_BASE_RIG
            T_map_rig = T_map_odom @ T_odom_rig
            T_keyframe_rig = T_map_rig  # keyframe 3 stands where the map begins
            self.stage.process(
                PlaceUpdate(self.seq, stamp_ns, T_map_odom, T_map_rig, UNIT, self.map_state, 3, T_keyframe_rig)
            )
        update = self.stage.process(
            OdometryUpdate(
                self.seq,
                stamp_ns,
                T_odom_rig,
                UNIT,
                velocity,
                UNIT,
                TrackingState.TRACKING,
                self.resets,
                100,
                100,
                DEPTH,
            )
        )
        if update is not None:
            self.updates.append(update)
        if update is not None and update.setpoint is not None:
            wanted = update.setpoint
            rate = (
                wanted.yaw_rate_radps
                if wanted.heading_rad is None
                else np.clip(3 * math.remainder(wanted.heading_rad - self.pose[2], math.tau), -1, 1)
            )
            self.velocity = np.array([wanted.velocity_mps, rate])
        heading = self.pose[2] + 0.05 * self.velocity[1]
        self.pose = self.pose + 0.1 * np.array(
            [self.velocity[0] * math.cos(heading), self.velocity[0] * math.sin(heading), self.velocity[1]]
        )
        return update

    def see(
        self, ranges: RangeScan, free: RangeScan, moving: tuple[MovingObstacle, ...] = (), *, age_ns: int = 0
    ) -> None:
        """Send a scan from the origin."""
        grid, stamp_ns = Floor().grid(np.zeros(3), ranges, np.minimum(free, 6.0)), self.seq * PERIOD_NS - age_ns
        self.stage.process(ObstacleScan(1, stamp_ns, ranges, ranges, free, np.eye(4), moving, grid=grid))

    def run(self, periods: int = 600) -> NavigationUpdate:
        """Advance until the drive has ended."""
        for _ in range(periods):
            update = self.pass_on()
            if update is not None and update.state.is_end:
                return update
        raise AssertionError(self.updates[-1])


def test_the_base_drives_to_a_goal_in_odom_and_in_the_map(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.pass_on()
    update = robot.send(GoalRequest(ODOM, 1.5, 0.5, 1.0), 77, 5)
    assert update.answer == (5, "goal", "") and update.command_ns == 77
    assert update.state is NavigationState.DRIVING and update.plan is not None and update.plan.frame == "odom"
    assert robot.run().state is NavigationState.REACHED
    np.testing.assert_allclose(robot.pose, [1.5, 0.5, 1.0], atol=0.03)
    goal = planar(T_MAP_ODOM @ transform(np.array([0.2, 1.5, -0.4])))
    robot.send(GoalRequest(MAP, *map(float, goal)))
    assert robot.run().state is NavigationState.REACHED
    np.testing.assert_allclose(robot.pose, [0.2, 1.5, -0.4], atol=0.03)


@pytest.mark.hazard("H27")
def test_a_refusal_names_the_remedy_and_sends_nothing(tmp_path: Path) -> None:
    robot = Robot(tmp_path)

    def refusal(request: NavigationRequest) -> str:
        update = robot.send(request)
        assert update.setpoint is None and update.answer is not None and update.state is NavigationState.IDLE
        return update.answer.refusal

    assert "no pose yet" in refusal(GoalRequest(ODOM, 1.0, 0.0))
    robot.in_map = False
    robot.pass_on()
    assert "not localised" in refusal(GoalRequest(MAP, 1.0, 0.0))
    assert "not localised" in refusal(RouteRequest(RouteAction.TEACH, "a"))
    assert "navigation.reach_m" in refusal(GoalRequest(ODOM, 500.0, 0.0))
    assert "begins 5.0 m away" in refusal(PathRequest(ODOM, np.array([[5.0, 0.0], [6.0, 0.0]])))
    assert "nothing is under way" in refusal(NavigationVerb.RESUME)
    assert "nothing is under way" in refusal(NavigationVerb.PAUSE)
    assert "no route is being taught" in refusal(RouteRequest(RouteAction.FINISH))
    robot.stage.process(ControllerState(disarmed_by="a stop was asked for", needs_request=True))
    assert "omnid arm" in refusal(GoalRequest(ODOM, 1.0, 0.0))
    assert "there is no route nowhere" in refusal(RouteRequest(RouteAction.REPEAT, "nowhere"))


def test_a_drive_waits_for_a_scan_but_not_for_an_old_one(tmp_path: Path) -> None:
    for age_ns, expected in ((0, NavigationState.BLOCKED), (3_000_000_000, NavigationState.DRIVING)):
        robot = Robot(tmp_path)
        robot.seq = 40
        robot.pass_on()
        robot.send(GoalRequest(ODOM, 3.0, 0.0))
        ranges = np.full(360, 0.5, np.float32)
        robot.see(ranges, ranges, age_ns=age_ns)
        for _ in range(8):
            robot.pass_on()
        assert robot.updates[-1].state is expected


def test_somebody_who_crosses_is_let_pass(tmp_path: Path) -> None:
    walker = MovingObstacle(1.6, 2.0, 0.0, -0.6, np.eye(4) * 1e-4, 0.2)
    for moving in ((walker,), ()):
        robot = Robot(tmp_path)
        robot.pass_on()
        robot.send(GoalRequest(ODOM, 4.0, 0.0))
        ranges = np.full(360, np.inf, np.float32)
        robot.see(ranges, ranges, moving)
        for _ in range(8):
            robot.pass_on()
        waits_or_avoids = robot.updates[-1].state is NavigationState.AVOIDING or robot.updates[-1].reason == CROSSES
        assert waits_or_avoids is bool(moving)


def test_unknown_floor_that_stops_the_wheels_is_passed(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.pass_on()
    robot.send(GoalRequest(ODOM, 4.0, 0.0))
    ranges, free = np.full(360, np.inf, np.float32), np.full(360, 6.0, np.float32)
    free[165:195] = 0.6
    robot.see(ranges, free)
    robot.stage.process(replace(ARMED, obstacle=UNKNOWN, blocked=True))
    robot.pass_on()
    assert robot.updates[-1].state is NavigationState.BLOCKED
    robot.stage.process(ARMED)
    robot.pass_on()
    assert robot.updates[-1].state is NavigationState.AVOIDING


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
    assert robot.answers[0] == Answer(True, "the route is written") and not update.teaching
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


def test_a_route_is_taught_on_after_a_reset_once_a_place_was_recognised(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.pass_on()
    robot.send(RouteRequest(RouteAction.TEACH, "hall"))
    robot.velocity = np.array([0.3, 0.0])
    for robot.resets, robot.map_state in (
        (0, MapState.LOCALIZED),
        (1, MapState.LOCALIZED),
        (1, MapState.ODOMETRY_ONLY),
    ):
        for _ in range(20):
            robot.pass_on()
    assert robot.updates[-1].teaching == "hall" and robot.updates[-1].taught_m == pytest.approx(1.8, abs=0.2)


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
    assert robot.updates[-1].state is NavigationState.NOT_LOCALISED and robot.updates[-1].setpoint == STANDSTILL
    late = PlaceUpdate(1, PERIOD_NS, np.eye(4), np.eye(4), UNIT, MapState.LOCALIZED, 3, np.eye(4))
    robot.stage.process(late)
    answer = robot.send(GoalRequest(NavigationFrame.MAP, 1.0, 0.0)).answer
    assert answer is not None and answer.refusal.startswith("not localised in a map")


TEACH, FINISH = RouteRequest(RouteAction.TEACH, "hall"), RouteRequest(RouteAction.FINISH)
REPEAT = RouteRequest(RouteAction.REPEAT, "hall", reverse=True)  # the robot stands at its end


def teaching(folder: Path) -> Robot:
    """Return a robot that has driven a route of 0.9 m, which is being taught."""
    robot = Robot(folder)
    robot.pass_on()
    robot.send(TEACH)
    for _ in range(30):
        robot.velocity = np.array([0.3, 0.0])
        robot.pass_on()
    robot.velocity = np.zeros(2)
    robot.pass_on()
    return robot


def test_a_full_disk_loses_no_recording(tmp_path: Path) -> None:
    folder = tmp_path / "routes"
    folder.write_text("in the way")
    robot = teaching(folder)
    robot.send(FINISH, id=1)
    assert not robot.answers[1].done and "navigation.routes" in robot.answers[1].text
    folder.unlink()
    assert not robot.send(FINISH, id=2).teaching and robot.answers[2].done
    assert list(RouteFiles(RouteFolder(folder)).routes) == ["hall"]


@pytest.mark.hazard("H50")
def test_no_request_needs_a_file_and_a_stop_ends_a_repetition(tmp_path: Path) -> None:
    robot = teaching(tmp_path)
    robot.send(FINISH)
    for path in tmp_path.iterdir():
        path.unlink()
    assert robot.send(REPEAT).state is NavigationState.DRIVING
    update = robot.send(NavigationVerb.CANCEL)
    assert update.state is not NavigationState.DRIVING and (update.setpoint is None or not update.setpoint.velocity_mps)


@pytest.mark.hazard("H26")
def test_a_request_from_before_a_stop_begins_nothing(tmp_path: Path) -> None:
    robot = teaching(tmp_path)
    robot.send(FINISH)
    robot.stage.process(replace(ARMED, stop_count=1))  # a bumper; then it was armed again
    assert robot.send(REPEAT, id=1).state is not NavigationState.DRIVING
    assert "a stop or a fault has come since" in robot.answers[1].text
    assert robot.send(REPEAT, id=2, stops=1).state is NavigationState.DRIVING and robot.answers[2].done
