"""A drive: its path and setpoints in odom, and the time since its last progress."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnid.core.control.heading_controller import Setpoint
from omnid.core.navigation.drive import PROGRESS_M, PROGRESS_RAD, Drive
from omnid.core.navigation.follower import Follower
from omnid.core.navigation.path import drive_path
from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.navigation.situation import MapPosition, Situation, WheelState
from omnid.tracking_state import MapState, TrackingState

T_MAP_ODOM = np.array([1.0, 2.0, math.pi / 2])


def drive(frame: NavigationFrame = NavigationFrame.MAP) -> Drive:
    path = drive_path([(1.0, 2.0), (1.0, 5.0)])
    return Drive("goal", frame, [path], Follower(path, NavigationSettings()), resets=0)


def now() -> Situation:
    wheels = WheelState(armed=True, needs_request=False)
    in_map = MapPosition(T_MAP_ODOM, MapState.LOCALIZED, 0.01)
    return Situation(1, np.zeros(3), 0.0, 0.0, TrackingState.TRACKING, 0, wheels, in_map)


def test_a_path_in_the_map_is_returned_in_odom() -> None:
    ahead = drive().path_ahead(now(), 1.0)
    assert np.allclose(ahead[0], (0.0, 0.0), atol=1e-6) and np.allclose(ahead[:, 1], 0.0, atol=1e-6)
    assert ahead[-1, 0] == pytest.approx(1.0, abs=0.06)


def test_a_heading_in_the_map_is_returned_in_odom() -> None:
    found = drive().in_odom(Setpoint(0.3, math.pi / 2), now())
    assert found.velocity_mps == 0.3 and found.heading_rad == pytest.approx(0.0)
    same = drive(NavigationFrame.ODOM).in_odom(Setpoint(0.3, 1.0), now())
    assert same.heading_rad == pytest.approx(1.0)
    turn = Setpoint(0.0, None, 0.5)
    assert drive().in_odom(turn, now()) is turn


def test_a_shorter_way_or_a_turn_is_progress() -> None:
    going, pose = drive(), np.zeros(3)
    assert going.stands_since_s(pose, 3.0, 0.1) == 0
    assert [going.stands_since_s(pose, 3.0 - 0.9 * PROGRESS_M, 0.1) for _ in range(3)] == pytest.approx([0.1, 0.2, 0.3])
    assert going.stands_since_s(pose, 3.0 - 1.1 * PROGRESS_M, 0.1) == 0
    assert going.stands_since_s(pose, 3.0, 0.1) == pytest.approx(0.1), "farther away again"
    assert going.stands_since_s(np.array([0, 0, 1.1 * PROGRESS_RAD]), 3.0, 0.1) == 0
