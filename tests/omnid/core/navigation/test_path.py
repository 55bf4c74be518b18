"""Paths: points at equal distances in legs, and what is read from them at a position."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from omnid.core.navigation.path import MAX_LENGTH_M, MAX_POINTS, STEP_M, drive_path, straight_leg
from omnid.errors import OmnidError


@pytest.mark.parametrize("points", [[(1.0, 2.0)], [(1.0, 2.0), (1.0, 2.0)]])
def test_a_single_place_is_no_path(points: list[tuple[float, float]]) -> None:
    with pytest.raises(OmnidError, match="a path"):
        drive_path(points)


def test_the_points_of_a_leg_are_no_farther_apart_than_its_step() -> None:
    for length_m in (0.07, 0.98, 1.0, 1.02):
        assert np.diff(straight_leg((0.0, 0.0), (length_m, 0.0)).s).max() <= STEP_M + 1e-9


def test_each_section_keeps_its_own_speed_up_to_the_end() -> None:
    (leg,) = drive_path([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)], speeds=[0.4, 0.3, 0.1]).legs
    assert leg.speed[np.searchsorted(leg.s, (0.5, 1.5, 2.0 - 1e-9))].tolist() == [0.3, 0.1, 0.1]


@pytest.mark.parametrize(("turn_deg", "legs"), [(35.0, 1), (-35.0, 1), (45.0, 2), (-45.0, 2), (180.0, 2)])
def test_a_leg_ends_where_the_path_turns_by_more_than_40_degrees(turn_deg: float, legs: int) -> None:
    turn = math.radians(turn_deg)
    for begin in (0.0, 3.0, -2.5):
        first = np.array([math.cos(begin), math.sin(begin)])
        then = np.array([math.cos(begin + turn), math.sin(begin + turn)])
        path = drive_path([(0.0, 0.0), first, first + then])
        assert len(path.legs) == legs and path.length_m == pytest.approx(2.0, abs=0.05)
        if legs == 2:
            np.testing.assert_allclose(path.legs[0].xy[-1], first)
            np.testing.assert_allclose(path.legs[1].xy[0], first)


def test_a_leg_ends_where_the_base_changes_between_forwards_and_backwards() -> None:
    points = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0)]
    legs = drive_path(points, backwards=[False, False, True, True]).legs
    assert [(leg.backwards, leg.length_m) for leg in legs] == [(False, pytest.approx(1.0)), (True, pytest.approx(2.0))]
    assert [leg.backwards for leg in drive_path(points, backwards=[True] * 4).legs] == [True]
    assert [leg.backwards for leg in drive_path(points).legs] == [False]


def test_nearer_points_than_10_cm_are_dropped_but_the_last_one_is_kept() -> None:
    noisy = [(0.0, 0.0), (0.04, 0.06), (0.5, 0.0), (0.53, 0.05), (1.0, 0.0), (1.05, 0.0)]
    path = drive_path(noisy)
    assert len(path.legs) == 1 and path.length_m == pytest.approx(1.05, abs=1e-3)
    np.testing.assert_allclose(path.goal, (1.05, 0.0))
    assert len(drive_path(noisy, backwards=[False] * 5 + [True]).legs) == 2, "the change of direction is kept"
    assert drive_path([(0.0, 0.0), (0.05, 0.0)]).length_m == pytest.approx(0.05)


def test_there_and_back_is_a_path_of_two_legs() -> None:
    path = drive_path([(0.0, 0.0), (1.0, 0.0), (0.0, 0.0)])
    assert len(path.legs) == 2 and path.length_m == pytest.approx(2.0)


@pytest.mark.parametrize("heading", [0.0, 1.2, -2.5, math.pi])
@pytest.mark.parametrize("length_m", [0.004, 0.04, 0.09, 0.2])
def test_the_shortest_leg_has_the_direction_from_its_start_to_its_goal(heading: float, length_m: float) -> None:
    leg = straight_leg((1.0, 2.0), (1.0 + length_m * math.cos(heading), 2.0 + length_m * math.sin(heading)))
    turned = np.remainder(leg.heading - heading + math.pi, math.tau) - math.pi
    np.testing.assert_allclose(turned, 0.0, atol=1e-6)
    np.testing.assert_allclose(leg.curvature, 0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((MAX_POINTS + 1, 2)), f"a path of {MAX_POINTS + 1} points"),
        ([(0.0, 0.0), (math.nan, 1.0)], "not finite"),
        ([(0.0, 0.0), (math.inf, 1.0)], "not finite"),
        ([(0.0, 0.0), (MAX_LENGTH_M + 1.0, 0.0)], "longer than 5000 m"),
        ([(0.0, 0.0), (0.0, 3000.0), (0.0, 0.0)], "longer than 5000 m"),
    ],
)
def test_other_points_are_no_path_and_the_message_says_why(points: ArrayLike, words: str) -> None:
    with pytest.raises(OmnidError, match=words):
        drive_path(points)
