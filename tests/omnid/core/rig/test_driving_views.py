"""Views of different places count, once in their period; the newest ones alone show a mirror that was knocked."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.rig.driving_views import RECENT_VIEWS, VIEWS, DrivingViews
from omnid.core.rig.rig_state import RigState
from tests.omnid.core.rig.shown_pairs import ShownPair
from tests.omnid.core.scenery import RenderedCameras

Room = tuple[RenderedCameras, NDArray[np.float64]]

SECOND_NS = 10**9


@pytest.fixture(scope="module")
def places(room: Room) -> list[ShownPair]:
    """Views of the places of a loop, a second apart."""
    cameras, poses = room
    return [ShownPair.of(cameras.frame(k, T), k * SECOND_NS) for k, T in enumerate(poses)]


def test_a_check_is_due_after_enough_views_of_different_places(room: Room, places: list[ShownPair]) -> None:
    views = DrivingViews(room[0].cylinder, 1.0)
    findings = [views.add(pair) for pair in places[:VIEWS]]
    assert findings[:-1] == [None] * (VIEWS - 1)
    assert findings[-1] is not None and findings[-1].state is RigState.FITS and views.new == 0


def test_a_robot_that_stands_has_one_view(room: Room, places: list[ShownPair]) -> None:
    views, stood = DrivingViews(room[0].cylinder, 1.0), places[0]
    for number in range(2 * VIEWS):
        assert views.add(ShownPair(number * SECOND_NS, stood.lower, stood.upper, stood.visible)) is None
    assert views.new == 1


def test_views_have_their_period_also_after_the_clock_was_set_back(room: Room, places: list[ShownPair]) -> None:
    views = DrivingViews(room[0].cylinder, 2.0)
    for pair in places[:6]:
        views.add(pair)
    assert views.new == 3
    back = places[9]
    views.add(ShownPair(1, back.lower, back.upper, back.visible))
    assert views.new == 4


def test_the_newest_views_show_a_mirror_that_was_knocked(room: Room, places: list[ShownPair]) -> None:
    views, columns = DrivingViews(room[0].cylinder, 1.0), round(4 / 360 * room[0].cylinder.width)
    for pair in places[:6]:
        assert views.add(pair) is None
    knocked = [np.roll(pair.upper.panorama, columns, axis=1) for pair in places[6:]]
    findings = []
    for pair, image in zip(places[6:], knocked, strict=True):
        padded = np.pad(image, ((0, 0), (pair.upper.pad_px, pair.upper.pad_px)), mode="wrap")
        upper = type(pair.upper)(padded, pair.upper.pad_px)
        findings.append(views.add(ShownPair(pair.stamp_ns, pair.lower, upper, pair.visible)))
    assert [finding is not None for finding in findings[:RECENT_VIEWS]] == [False, False, True]
    newest = findings[RECENT_VIEWS - 1]
    assert newest is not None and newest.state is RigState.BROKEN
