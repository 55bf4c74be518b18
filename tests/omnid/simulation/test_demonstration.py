"""`omnid demo --drive`: the requests of its script, and its image."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from calib import se3
from omnid.controller.statistics import ControllerState
from omnid.core.navigation.requests import GoalRequest, PathRequest
from omnid.messages import NavigationUpdate
from omnid.navigation_state import NavigationState
from omnid.simulation.demonstration import GOALS, SIDE_M, SquareTwice, apart_m, draw
from omnid.simulation.lockstep import Moment
from omnid.simulation.world_file import load_world

CORNERS = [(0.0, 0.0), (SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0), (0.0, 0.0)]


def moment(time_s: float, place: tuple[float, float], state: NavigationState | None) -> Moment:
    """Return a moment of an armed robot that knows where it is."""
    navigation = None if state is None else NavigationUpdate(0, 0, None, state, "why")
    seen = cast("Any", object())  # only whether there is a pose counts
    return Moment(time_s, np.eye(4), ControllerState(armed=True), seen, se3.transform(np.eye(3), [*place, 0.0]),
                  navigation, None)


def test_the_square_is_driven_by_goals_and_again_along_its_path() -> None:
    lines: list[str] = []
    script, asked = SquareTwice(lines.append), []
    assert list(script(replace(moment(0.0, CORNERS[0], None), odometry=None))) == []
    assert list(script(replace(moment(0.1, CORNERS[0], None), controller=ControllerState()))) == ["arm"]
    for number, place in enumerate(CORNERS):
        state = NavigationState.REACHED if number else NavigationState.IDLE
        asked += list(script(moment(10.0 * number + 1, place, state)))
        assert list(script(moment(10.0 * number + 2, place, NavigationState.DRIVING))) == []
    goals, path, end = asked[:4], asked[4], asked[5]
    assert [(goal.x_m, goal.y_m, goal.heading_rad) for goal in goals if isinstance(goal, GoalRequest)] == list(GOALS)
    assert isinstance(path, PathRequest) and path.xy.tolist() == [list(corner) for corner in CORNERS[:5]]
    assert end == "end" and script.end == "reached" and script.repeated_s == 41.0 and len(lines) == 5


def test_a_drive_that_fails_is_reported() -> None:
    script = SquareTwice(lambda line: None)
    list(script(moment(1.0, (0.0, 0.0), NavigationState.REACHED)))
    assert list(script(moment(9.0, (0.5, 0.0), NavigationState.FAILED))) == ["end"]
    assert script.end == "failed: why" and math.isinf(script.repeated_s)


def test_both_paths_are_drawn() -> None:
    first = np.array([[-1.0, -1.0], [0.0, -1.0], [0.0, 0.0]])
    aside = np.array([0.0, 0.5])
    image = draw(load_world("room", 1), first, first + aside)
    assert image.shape[0] < image.shape[1] and image.dtype == np.uint8
    red = (image[..., 2].astype(int) - image[..., 0] > 100).sum()
    assert red > 200 and (image.max(axis=2) < 40).sum() > 300
    assert apart_m(first, first + aside).max() == pytest.approx(0.5)
