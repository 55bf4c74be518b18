"""`omnid demo --drive`: the requests of its script, and drives that fail."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from omnid.controller.statistics import ControllerState
from omnid.core.navigation.path import drive_path
from omnid.core.navigation.requests import PathRequest, RouteAction, RouteRequest
from omnid.messages import NavigationUpdate, PlaceUpdate, RequestAnswer
from omnid.navigation_state import NavigationState
from omnid.simulation.demonstration import RECOGNISED_S, TeachAndRepeat
from omnid.simulation.lockstep import Moment, Request
from omnid.tracking_state import MapState

REACHED, DRIVING = NavigationState.REACHED, NavigationState.DRIVING


def moment(
    time_s: float, state: NavigationState | None, map_state: MapState = MapState.LOCALIZED, refusal: str = ""
) -> Moment:
    """Return a moment of an armed robot."""
    answer = RequestAnswer(1, "teach", refusal)
    navigation = None if state is None else NavigationUpdate(0, 0, None, state, "why", answers=(answer,))
    seen = cast("Any", object())  # only whether there is a pose counts
    place = PlaceUpdate(0, 0, np.eye(4), np.eye(4), np.eye(6), map_state, 0, np.eye(4))
    return Moment(time_s, np.eye(4), ControllerState(armed=True), seen, np.eye(4), navigation, place)


def begun() -> tuple[TeachAndRepeat, list[str]]:
    """Return a script that has sent its first requests, and the list of its lines."""
    lines: list[str] = []
    script = TeachAndRepeat(lines.append)
    assert list(script(replace(moment(0.0, None), place=None))) == []
    assert list(script(replace(moment(0.1, None), controller=ControllerState()))) == ["arm"]
    teach, path = script(moment(1.0, None, MapState.ODOMETRY_ONLY))
    assert teach == RouteRequest(RouteAction.TEACH, "demo", replace=True)
    assert isinstance(path, PathRequest) and len(drive_path(path.xy).legs) == 1, "it is driven without a halt"
    return script, lines


def test_the_route_is_taught_and_repeated_when_its_start_is_recognised() -> None:
    script, lines = begun()
    sent: list[Request] = []
    for at_s, state, map_state in (
        (1.2, REACHED, MapState.ODOMETRY_ONLY),
        (9.0, DRIVING, MapState.ODOMETRY_ONLY),
        (17.0, REACHED, MapState.ODOMETRY_ONLY),
        (18.0, REACHED, MapState.LOCALIZED),
        (18.1, REACHED, MapState.LOCALIZED),
        (30.0, DRIVING, MapState.LOCALIZED),
    ):
        sent += list(script(moment(at_s, state, map_state)))
    assert sent == [RouteRequest(RouteAction.FINISH), RouteRequest(RouteAction.REPEAT, "demo")]
    assert script.repeated_s == 18.0
    assert list(script(moment(36.0, REACHED))) == ["end"] and script.end == "reached"
    assert any("repeats" in line for line in lines)


@pytest.mark.parametrize(
    ("at_s", "state", "map_state", "refusal", "end"),
    [
        (9.0, NavigationState.FAILED, MapState.LOCALIZED, "", "failed: why"),
        (9.0, DRIVING, MapState.LOCALIZED, "no map", "refused: no map"),
        (17.1 + RECOGNISED_S, REACHED, MapState.ODOMETRY_ONLY, "", "the start of the route was not recognised"),
    ],
)
def test_a_drive_that_fails_is_reported(
    at_s: float, state: NavigationState, map_state: MapState, refusal: str, end: str
) -> None:
    script, _ = begun()
    list(script(moment(17.0, REACHED, MapState.ODOMETRY_ONLY)) if at_s > 17.0 else ())
    assert list(script(moment(at_s, state, map_state, refusal))) == ["end"]
    assert script.end == end and math.isinf(script.repeated_s)
