"""Paths: points at equal distances in legs, and what is read from them at a position."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnid.core.navigation.path import STEP_M, drive_path, straight_leg
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
