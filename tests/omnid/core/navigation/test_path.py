"""Paths: points at equal distances in legs, and what is read from them at a position."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from omnid.core.navigation.path import MAX_LENGTH_M, MAX_POINTS, STEP_M, PathLeg, _leg, drive_path, straight_leg
from omnid.errors import OmnidError


@pytest.mark.parametrize("length_m", [0.15, 0.6, 3.0])
def test_two_points_are_a_path(length_m: float) -> None:
    path = drive_path([(1.0, 0.0), (1.0, length_m)])
    assert len(path.legs) == 1 and path.length_m == pytest.approx(length_m)
    np.testing.assert_allclose(path.goal, (1.0, length_m))


@pytest.mark.parametrize("points", [[(1.0, 2.0)], [(1.0, 2.0), (1.0, 2.0)]])
def test_a_single_place_is_no_path(points: list[tuple[float, float]]) -> None:
    with pytest.raises(OmnidError, match="a path"):
        drive_path(points)


def test_the_points_of_a_leg_are_no_farther_apart_than_its_step() -> None:
    for length_m in (0.07, 0.98, 1.0, 1.02):
        assert np.diff(straight_leg((0.0, 0.0), (length_m, 0.0)).s).max() <= STEP_M + 1e-9


def test_each_section_keeps_its_own_speed_up_to_the_end() -> None:
    (leg,) = drive_path([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)], speeds=[0.4, 0.3, 0.1]).legs
    assert [leg.speed_at(s_m) for s_m in (0.5, 1.5, 2.0)] == [0.3, 0.1, 0.1]


def test_the_way_on_a_leg_goes_on_past_its_end() -> None:
    leg = straight_leg((0.0, 0.0), (2.0, 0.0))
    assert leg.project((2.3, 0.1), 2.0) == pytest.approx(2.3)
    assert leg.project((1.23, 0.1), 1.2) == pytest.approx(1.23)


@pytest.mark.parametrize("heading", [0.0, 0.7, math.pi / 2, -2.5])
def test_a_position_to_the_left_of_a_leg_has_a_positive_offset(heading: float) -> None:
    ahead, left = np.array([math.cos(heading), math.sin(heading)]), np.array([-math.sin(heading), math.cos(heading)])
    leg = straight_leg((1.0, -2.0), (1.0, -2.0) + 3.0 * ahead)
    for offset_m in (0.3, -0.2):
        assert leg.offset_m((1.0, -2.0) + 1.2 * ahead + offset_m * left, 1.0) == pytest.approx(offset_m)


def test_the_sharpest_curve_is_searched_ahead() -> None:
    """A straight way of 2 m, then an arc of radius 0.5 m to the right."""
    a = np.linspace(0.0, math.pi / 2, 8)
    arc = np.column_stack([2.0 + 0.5 * np.sin(a), 0.5 * np.cos(a) - 0.5])
    (leg,) = drive_path([(0.0, 0.0), *arc]).legs
    assert leg.sharpest(1.5, 0.3) == pytest.approx(0.0, abs=1e-6)
    assert leg.sharpest(1.5, 0.9) == pytest.approx(2.0, rel=0.15)


def test_the_points_of_a_curve_have_its_direction_and_curvature() -> None:
    """An arc of radius 1 m to the left, from heading 0 on, given every 15 cm."""
    a = np.linspace(0.0, 2.4, 17)
    (leg,) = drive_path(np.column_stack([3.0 + np.sin(a), -1.0 - np.cos(a)])).legs
    assert leg.length_m == pytest.approx(2.4, abs=0.01)
    for s_m in (0.4, 1.1, 2.0):
        x, y, heading = leg.at(s_m)
        np.testing.assert_allclose((x, y), (3.0 + math.sin(s_m), -1.0 - math.cos(s_m)), atol=0.01)
        assert heading == pytest.approx(s_m, abs=0.03)
    inner = (leg.s > 0.2) & (leg.s < 2.2)
    assert np.convolve(leg.curvature, np.ones(3) / 3, "same")[inner] == pytest.approx(1.0, abs=0.25)
    (other,) = drive_path(np.column_stack([np.sin(a), np.cos(a) - 1.0])).legs
    np.testing.assert_allclose(other.curvature, -leg.curvature, atol=1e-9)
    assert np.diff(leg.heading).max() < 0.1, "it is not wrapped"


def test_beyond_both_ends_the_path_continues_straight() -> None:
    leg = straight_leg((1.0, 1.0), (1.0, 3.0))
    np.testing.assert_allclose(leg.at(-0.5), (1.0, 0.5, math.pi / 2))
    np.testing.assert_allclose(leg.at(2.5), (1.0, 3.5, math.pi / 2))
    np.testing.assert_allclose(leg.at(0.77), (1.0, 1.77, math.pi / 2))


def test_the_nearest_point_is_searched_from_half_a_metre_behind_to_two_metres_ahead() -> None:
    there_and_back = [(0.0, 0.0), (4.0, 0.0), (4.6, 0.3), (4.6, 0.6), (4.0, 0.8), (0.0, 0.8)]
    leg = _one_leg(there_and_back)
    assert leg.project((2.0, 0.5), 2.0) == pytest.approx(2.0), "although the way back is nearer"
    assert leg.project((2.0, 0.3), 7.0) == pytest.approx(leg.length_m - 2.0, abs=0.05)
    straight = straight_leg((0.0, 0.0), (9.0, 0.0))
    assert straight.project((4.6, 0.0), 5.0) == pytest.approx(4.6)
    assert straight.project((3.0, 0.0), 5.0) == pytest.approx(4.5, abs=0.11)
    assert straight.project((6.9, 0.0), 5.0) == pytest.approx(6.9)
    assert straight.project((8.5, 0.0), 5.0) == pytest.approx(7.0, abs=0.11)
    assert straight.project((-3.0, 0.0), 0.0) == pytest.approx(-STEP_M), "not farther before the start"


def _one_leg(points: list[tuple[float, float]]) -> PathLeg:
    """Return the leg through points, whatever its corners."""
    fine = np.vstack([np.linspace(a, b, 200) for a, b in itertools.pairwise(points)])
    return _leg(fine, np.full(len(fine), math.inf), False)


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


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("is_back", [False, True])
def test_a_last_point_nearby_and_aside_is_no_corner(count: int, is_back: bool) -> None:
    points = [*((x, 0.0) for x in np.linspace(0.0, 1.0, count)), (1.03, 0.05)]
    (leg,) = drive_path(points, backwards=[is_back] * len(points)).legs
    np.testing.assert_allclose(leg.xy[-1], (1.03, 0.05))
    assert leg.backwards == is_back
    legs = drive_path(points, backwards=[is_back] * count + [not is_back]).legs
    assert [leg.backwards for leg in legs] == [is_back, not is_back], "but a change of direction is one"


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


def test_the_heading_at_the_end_is_wrapped_and_may_be_missing() -> None:
    assert drive_path([(0.0, 0.0), (1.0, 0.0)], 4.0).final_heading_rad == pytest.approx(4.0 - math.tau)
    assert drive_path([(0.0, 0.0), (1.0, 0.0)]).final_heading_rad is None
