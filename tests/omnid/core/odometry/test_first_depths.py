"""The first motion decides among depths that repeat: its direction without depths, and votes for its length."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.first_depths import LEAD_VOTES, WHEELS_RATIO, most_likely_motion, reach_m, voted

Array = NDArray[np.float64]

FOCAL_PX = 140.0
MOVED_M, WORLD = 0.1, 1.6  # distance, and by what a world is larger that repeats in the same way
ANYWHERE = (0.0, 10.0)


def walls(count: int = 200) -> Array:
    """Return points (N, 3) [m] of two walls beside the origin and of one at their end."""
    rng = np.random.default_rng(5)
    along, up = rng.uniform(-3, 3, count), rng.uniform(-0.8, 0.8, count)
    points = np.column_stack([along, np.where(np.arange(count) % 2, 1.2, -1.0), up])
    points[::5, :2] = np.column_stack([np.full(count, 3.0), rng.uniform(-1, 1.2, count)])[::5]
    return points


def bearings(points: Array) -> Array:
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


@pytest.mark.parametrize(("direction_deg", "turn_deg"), [(0.0, 0.0), (30.0, 4.0), (150.0, -6.0)])
def test_the_motion_is_found_without_depths(direction_deg: float, turn_deg: float) -> None:
    before, direction, turn = walls(), math.radians(direction_deg), math.radians(turn_deg)
    moved = MOVED_M * np.array([math.cos(direction), math.sin(direction), 0.0])
    now = before @ se3.rotation_exp([0.0, 0.0, turn]).T + moved
    now[:20] = np.random.default_rng(3).permutation(now[:20])  # wrong tracks
    found = most_likely_motion(bearings(before), bearings(now), FOCAL_PX)
    assert found == pytest.approx((direction, turn), abs=math.radians(1.5))


def votes_of(repeating: int, others: int) -> tuple[Array, Array]:
    """Return logarithms (N, 3) of distances and sigmas of landmarks that repeat, and of others."""
    rng = np.random.default_rng(7)
    count = repeating + others
    distances = (
        math.log(MOVED_M) + rng.normal(0.0, 0.03, (count, 1)) + np.array([0.0, math.log(WORLD), -math.log(WORLD)])
    )
    distances[repeating:, 1:] = np.nan
    return distances, np.full(distances.shape, 0.05)


def test_landmarks_that_do_not_repeat_decide_on_the_distance() -> None:
    found = voted(*votes_of(100, math.ceil(LEAD_VOTES) + 8), ANYWHERE)
    assert found is not None and found.moved_m == pytest.approx(MOVED_M, rel=0.05) and found.runner_up_m is None


def test_a_distance_with_nearly_as_many_votes_is_the_runner_up() -> None:
    found = voted(*votes_of(100, 5), ANYWHERE)
    assert found is not None and found.moved_m == pytest.approx(MOVED_M, rel=0.05)
    assert found.runner_up_m in (pytest.approx(MOVED_M * WORLD, rel=0.05), pytest.approx(MOVED_M / WORLD, rel=0.05))


@pytest.mark.parametrize("reach_m", [(0.08, 0.13), (0.08, 0.12)])
def test_a_distance_out_of_reach_is_no_runner_up(reach_m: tuple[float, float]) -> None:
    found = voted(*votes_of(100, 0), reach_m)
    assert found is not None and found.moved_m == pytest.approx(MOVED_M, rel=0.05) and found.runner_up_m is None


@pytest.mark.parametrize(
    ("sensed_m", "reach"),
    [(math.nan, (0.0, 0.5)), (0.01, (0.0, 0.5)), (0.3, (0.3 / WHEELS_RATIO, 0.3 * WHEELS_RATIO))],
)
def test_wheels_bound_the_distance_once_they_turn(sensed_m: float, reach: tuple[float, float]) -> None:
    assert reach_m(0.5, sensed_m) == pytest.approx(reach)


def test_few_or_scattered_votes_decide_nothing() -> None:
    assert voted(*votes_of(20, 5), ANYWHERE) is None
    assert voted(*votes_of(100, 0), (5.0, 6.0)) is None
    distances, sigmas = votes_of(0, 100)
    distances[:, 0] = np.linspace(math.log(0.01), math.log(10.0), 100)
    assert voted(distances, sigmas, ANYWHERE) is None


def test_in_a_narrow_view_of_a_wall_no_motion_is_the_likeliest() -> None:
    """A step aside before a wall 3 m away looks like a turn where the view is 20 degrees wide."""
    rng = np.random.default_rng(9)
    wall = np.column_stack([np.full(200, 3.0), rng.uniform(-0.5, 0.5, 200), rng.uniform(-0.4, 0.4, 200)])
    assert most_likely_motion(bearings(wall), bearings(wall - (0.0, 0.1, 0.0)), FOCAL_PX) is None


@pytest.mark.parametrize("turn_deg", [8.0, 12.0, 15.0, 25.0])
@pytest.mark.parametrize("moved_m", [0.0, 0.1, 0.3])
def test_a_turn_beyond_those_that_are_tried_shows_no_motion(turn_deg: float, moved_m: float) -> None:
    now = walls() @ se3.rotation_exp([0.0, 0.0, math.radians(turn_deg)]).T + (moved_m, 0.0, 0.0)
    assert most_likely_motion(bearings(walls()), bearings(now), FOCAL_PX) is None
