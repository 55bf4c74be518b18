"""Inputs of the navigation at a pose, and reasons to refuse or to wait that follow from them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnid.core.navigation.requests import NavigationFrame
from omnid.core.navigation.situation import MapPosition, Situation, WheelState, refusal_to_drive
from omnid.tracking_state import MapState, TrackingState


@pytest.mark.parametrize(
    ("change", "frame", "words"),
    [
        ({"wheels": WheelState(False, True, "not armed since the start")}, "odom", "omnid arm"),
        ({"state": TrackingState.LOST}, "odom", "odometry is lost"),
        ({"in_map": None}, "map", "not localised"),
        ({"in_map": MapPosition(np.zeros(3), MapState.ODOMETRY_ONLY, 0.01)}, "map", "not localised"),
        ({"in_map": MapPosition(np.zeros(3), MapState.LOCALIZED, 0.5)}, "map", "uncertain by 0.50 m"),
        ({"in_map": MapPosition(np.zeros(3), MapState.LOCALIZED, math.nan)}, "map", "uncertain"),
        ({"in_map": None}, "odom", ""),
    ],
)
def test_refusals_name_the_remedy(change: dict[str, object], frame: str, words: str) -> None:
    now = Situation(
        0,
        np.zeros(3),
        0.0,
        0.0,
        TrackingState.TRACKING,
        0,
        WheelState(True, False),
        MapPosition(np.zeros(3), MapState.LOCALIZED, 0.02),
    )._replace(**change)  # type: ignore[arg-type]
    refusal = refusal_to_drive(now, NavigationFrame(frame), 0.3)
    assert words in refusal and bool(refusal) == bool(words) and "\n" not in refusal
    assert "no pose" in refusal_to_drive(None, NavigationFrame(frame), 0.3)


def test_only_a_drive_in_the_map_follows_the_place_of_odom_in_it() -> None:
    in_map = MapPosition(np.array([1.0, 2.0, math.pi / 2]), MapState.LOCALIZED, 0.02)
    pose = np.array([0.5, 0.25, 0.1])
    now = Situation(0, pose, 0.0, 0.0, TrackingState.TRACKING, 0, WheelState(True, False), in_map)
    np.testing.assert_allclose(now.pose_in(NavigationFrame.ODOM), pose)
    np.testing.assert_allclose(now.map_pose(), (1.0 - 0.25, 2.0 + 0.5, math.pi / 2 + 0.1))
    np.testing.assert_allclose(now._replace(in_map=None).map_pose(), pose)
