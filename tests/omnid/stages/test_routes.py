"""Routes are taught and repeated, also in a map that is new."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from omnid.core.navigation.follower import STAND
from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationFrame,
    RouteAction,
    RouteRequest,
)
from omnid.messages import PlaceUpdate
from omnid.navigation_state import NavigationState
from omnid.tracking_state import MapState
from tests.omnid.stages.test_navigation import (
    ODOM,
    PERIOD_NS,
    UNIT,
    Robot,
    fixed_map,
)


@pytest.mark.hazard("H29")
def test_a_route_is_taught_and_repeated(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    robot.pass_on()
    robot.send(RouteRequest(RouteAction.TEACH, "hall"))
    assert "is being taught" in (robot.send(RouteRequest(RouteAction.REPEAT, "hall")).answer or ("",) * 3)[2]
    for k in range(150):
        robot.velocity = np.array([0.3, 0.4 * math.sin(k / 20)])
        robot.pass_on()
    robot.velocity = np.zeros(2)
    update = robot.pass_on()
    assert robot.updates[-1].teaching == "hall" and robot.updates[-1].taught_m == pytest.approx(4.5, abs=0.2)
    update = robot.send(RouteRequest(RouteAction.FINISH))
    assert update.answer is not None and not update.answer.refusal and not update.teaching
    update = robot.send(RouteRequest(RouteAction.TEACH, "hall"))
    assert update.answer is not None and "there is a route hall already" in update.answer.refusal
    assert robot.send(RouteRequest(RouteAction.TEACH, "hall", replace=True)).teaching == "hall"
    robot.send(RouteRequest(RouteAction.STOP))  # so that the old one stays
    end = robot.pose.copy()
    robot.send(RouteRequest(RouteAction.REPEAT, "hall", reverse=True))
    assert robot.updates[-1].task == "route hall"
    assert robot.run(1200).state is NavigationState.REACHED
    assert math.hypot(*robot.pose[:2]) < 0.1
    robot.send(RouteRequest(RouteAction.REPEAT, "hall"))
    assert robot.run(1200).state is NavigationState.REACHED
    np.testing.assert_allclose(robot.pose[:2], end[:2], atol=0.1)
    other = Robot(tmp_path, fixed_map(stamp_ns=6))
    other.pass_on()
    update = other.send(RouteRequest(RouteAction.REPEAT, "hall"))
    assert update.answer is not None and "in the map site.omap, built again since" in update.answer.refusal
    other.routes.map_name = "hall.omap"
    update = other.send(RouteRequest(RouteAction.REPEAT, "hall"))
    assert update.answer is not None and "in the map site.omap, and not in hall.omap" in update.answer.refusal
    other.routes.map_name = ""
    update = other.send(RouteRequest(RouteAction.TEACH, "x"))
    assert update.answer is not None and "--map FILE.omap" in update.answer.refusal


def test_a_route_is_taught_in_a_new_map_while_nothing_is_recognised_yet(tmp_path: Path) -> None:
    for is_new in (True, False):
        robot = Robot(tmp_path, fixed_map(is_new=is_new))
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
