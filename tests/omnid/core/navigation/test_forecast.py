"""Moving obstacles on a path."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from omnid.core.navigation.forecast import Forecast, Pace, forecast, yielding
from omnid.core.obstacles.moving_obstacle import MovingObstacle
from tests.omnid.core.navigation.test_moving_people import at


def test_the_share_of_the_speed_by_hand() -> None:
    path = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
    pace = Pace(0.4, 0.4, 0.3, 0.4, 0.26)

    def judged(length_m: float, moving: Forecast) -> tuple[float, bool]:
        share, coming = yielding(path, length_m, moving, pace)
        return share, bool(coming[0])

    assert judged(4.0, at(3.0, 2.0, 0.0, 0.0)) == (1.0, False)
    # In 2.5 s the base is at 1 m, and the person, from 2 m aside at 0.8 m/s, there as well.
    share, coming = judged(4.0, at(1.0, 2.0, 0.0, -0.8))
    assert 0.0 <= share < 1.0 and not coming
    assert judged(0.2, at(1.0, 2.0, 0.0, -0.8)) == (1.0, False), "it turns at a corner before"
    assert judged(4.0, at(1.5, 0.0, -0.5, 0.0)) == (1.0, True), "it comes to where the base would wait"
    assert judged(4.0, at(-0.8, 0.0, 0.8, 0.0)) == (1.0, False), "it comes from behind"
    share, coming = judged(4.0, at(0.8, 0.0, 0.2, 0.0))
    assert share == 0.5 and not coming, "it walks ahead, more slowly"


def test_a_fast_one_from_the_side_is_not_taken_for_one_from_behind() -> None:
    path = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
    pace = Pace(0.4, 0.4, 0.3, 0.4, 0.26)
    share, coming = yielding(path, 4.0, at(-0.5, 0.9, 2.0, -0.8), pace)
    assert share < 1.0 and not coming[0], "119 degrees from the direction of the path"
    assert yielding(path, 4.0, at(-0.57, 0.9, 2.0, -0.8), pace).share == 1.0, "122 degrees"


def test_points_where_it_was_longer_ago_than_the_ring_remembers_are_of_others() -> None:
    points = np.array([(-0.9, 0.0), (-1.0, 0.0), (0.4, 0.0), (0.5, 0.0)])
    np.testing.assert_array_equal(at(0.0, 0.0, 1.0, 0.0).others(points), points[[1, 3]])
    beside = np.array([(-0.25, 0.43), (-0.25, -0.47)])
    np.testing.assert_array_equal(at(0.0, 0.0, 1.0, 0.0).others(beside), beside[[1]])


def test_an_uncertain_velocity_that_belongs_to_an_uncertain_place_makes_it_more_uncertain() -> None:
    P = np.diag([0.01, 0.01, 0.01, 0.01])
    P[0, 2] = P[2, 0] = P[1, 3] = P[3, 1] = 0.005
    found = forecast([MovingObstacle(1.0, 0.0, 0.5, 0.0, P, 0.2)], 0.4)
    assert found is not None
    np.testing.assert_allclose(found.variance, [[0.01 + 0.8 * 0.005 + 0.16 * 0.01, 0.005 + 0.4 * 0.01, 0.01]])


def test_a_forecast_goes_on_from_the_age_of_the_ring() -> None:
    one = MovingObstacle(1.0, 0.0, 0.5, 0.0, np.diag([0.01, 0.01, 0.04, 0.04]), 0.2)
    places, radii = forecast([one], 0.4).at(np.array([0.0, 1.0]))  # type: ignore[union-attr]
    np.testing.assert_allclose(places[0], [(1.2, 0.0), (1.7, 0.0)])
    np.testing.assert_allclose(radii[0], 0.2 + np.minimum(np.sqrt([0.01 + 0.04 * 0.16, 0.01 + 0.04 * 1.96]), 0.15))
    assert forecast([], 0.1) is None


def slowly_judged(
    path: list[tuple[float, float]], length_m: float, moving: Forecast, pace: Pace
) -> tuple[float, list[bool]]:
    """Return share and those that come as `yielding` does, by driving along the path in steps of 0.2 s."""
    along = [0.0]
    for a, b in itertools.pairwise(path):
        along.append(along[-1] + math.dist(a, b))

    def at_way(way_m: float) -> tuple[float, float, float, float]:
        """Return place and direction."""
        k = max(k for k in range(len(path) - 1) if along[k] <= way_m)
        dx, dy = ((path[k + 1][axis] - path[k][axis]) / (along[k + 1] - along[k]) for axis in range(2))
        return path[k][0] + (way_m - along[k]) * dx, path[k][1] + (way_m - along[k]) * dy, dx, dy

    def comes_to_the_start(k: int) -> bool:
        times = np.arange(0.0, 10.0, 0.01)
        away_m = np.hypot(*(moving.xy[k] + np.outer(times, moving.velocity[k]) - path[0]).T)
        return bool(away_m.argmin() > 0 and away_m.min() < moving.radius_m[k] + pace.standing_room_m)

    coming = [False] * len(moving.xy)
    for share in (1.0, 0.75, 0.5, 0.25, 0.0):
        met, behind = [False] * len(moving.xy), [False] * len(moving.xy)
        speed_mps, way_m, most_mps = pace.speed_mps, 0.0, share * pace.highest_mps
        for step in range(21):
            if step:
                change = pace.acceleration_mps2 * 0.2
                after = speed_mps + min(max(most_mps - speed_mps, -change), change)
                speed_mps, way_m = after, way_m + 0.2 * (speed_mps + after) / 2
            reached_m = min(way_m, length_m, along[-1])
            x, y, dx, dy = at_way(reached_m)
            drives = speed_mps > 0.01 and reached_m < length_m
            for k in range(len(met)):
                to = moving.xy[k] + 0.2 * step * moving.velocity[k] - (x, y)
                radius_m = moving.at(np.array([0.2 * step]))[1][k, 0]
                ahead_m = float(to @ (dx, dy))
                behind[k] = behind[k] or (step == 0 and ahead_m < -0.5 * np.hypot(*to))
                near = np.hypot(*to) < radius_m + (pace.moving_room_m if drives else pace.standing_room_m)
                met[k] = met[k] or bool(near and ahead_m > 0)
        met = [meets and not comes_up for meets, comes_up in zip(met, behind, strict=True)]
        if share == 1.0:
            coming = [meets and comes_to_the_start(k) for k, meets in enumerate(met)]
        if not any(meets and not comes for meets, comes in zip(met, coming, strict=True)):
            return share, coming
    return 0.0, coming


@pytest.mark.parametrize("seed", range(4))
def test_the_share_of_the_speed_is_that_of_a_drive_in_small_steps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = [(3.0 + 0.05 * k, -2.0) for k in range(21)] + [(4.0 + 0.03 * k, 0.04 * k - 2.0) for k in range(1, 31)]
    shares = []
    for _ in range(6):
        goals = np.array(path)[rng.integers(5, 40, 3)]
        velocity = rng.uniform(0.2, 0.9, (3, 1)) * rng.normal(0.0, 1.0, (3, 2))
        variance = np.column_stack([rng.uniform(1e-4, 0.01, 3), np.zeros(3), rng.uniform(1e-4, 0.01, 3)])
        when_s = rng.uniform(1.0, 4.0, (3, 1))
        moving = Forecast(goals - when_s * velocity, velocity, rng.uniform(0.1, 0.3, 3), variance)
        pace = Pace(float(rng.uniform(0.0, 0.4)), float(rng.choice([0.4, 0.9])), 0.3, 0.4, 0.26)
        length_m = float(rng.choice([0.8, 2.0, 9.0]))
        share, coming = yielding(np.array(path), length_m, moving, pace)
        assert (share, coming.tolist()) == slowly_judged(path, length_m, moving, pace)
        shares.append(share)
    assert len(set(shares)) > 1


def test_the_last_points_of_a_path_are_judged_as_well() -> None:
    pace = Pace(0.0, 0.4, 0.3, 0.4, 0.26)
    assert yielding(np.array([(0.0, 0.0)]), 0.0, at(0.3, 0.1, 0.0, 0.0), pace).share == 1.0, "it stands"
    two = np.array([(0.0, 0.0), (0.3, 0.0)])
    assert yielding(two, 0.3, at(0.7, 0.0, 0.0, 0.0), pace).share < 1.0


def test_who_stands_before_the_base_and_begins_to_walk_away_does_not_come() -> None:
    pace = Pace(0.0, 0.4, 0.3, 0.4, 0.26)
    path = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
    share, coming = yielding(path, 4.0, at(0.3, 0.0, 0.1, 0.0), pace)
    assert share == 0.0 and not coming[0]


def test_the_radius_grows_with_the_uncertainty_of_place_and_velocity_together() -> None:
    moving = Forecast(np.zeros((1, 2)), np.zeros((1, 2)), np.array([0.2]), np.array([[1e-3, 1e-3, 2e-3]]))
    _, radii = moving.at(np.array([0.0, 0.5, 2.0]))
    expected = [math.sqrt(1e-3 + 2 * t * 1e-3 + t**2 * 2e-3) for t in (0.0, 0.5, 2.0)]
    np.testing.assert_allclose(radii[0] - 0.2, expected)


def test_the_outline_of_who_comes_is_where_both_meet() -> None:
    """From 3 m away, at 0.5 m/s, towards a base at 0.25 m/s: after 4 s the person is 1 m from where the base was."""
    moving = at(3.0, 0.0, -0.5, 0.0)
    outline = moving.outlines(np.array([True]), np.zeros(2), 0.25).reshape(3, 12, 2)
    np.testing.assert_allclose(outline.mean(axis=1), [(1.3, 0.0), (1.0, 0.0), (0.7, 0.0)], atol=1e-9)
    centres = outline.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(np.hypot(*np.moveaxis(outline - centres, -1, 0)), 0.2)
    fast = at(1.5, 0.0, -0.5, 0.0)
    outline_of_fast = fast.outlines(np.array([True]), np.zeros(2), 0.5)
    np.testing.assert_allclose(outline_of_fast.reshape(3, 12, 2).mean(axis=1)[:, 0], [1.05, 0.75, 0.45])
    there = Forecast(np.add(fast.xy, (5.0, -4.0)), fast.velocity, fast.radius_m, fast.variance)
    np.testing.assert_allclose(
        there.outlines(np.array([True]), np.array([5.0, -4.0]), 0.5), np.add(outline_of_fast, (5.0, -4.0))
    )
    near = at(0.2, 0.0, -0.5, 0.0).outlines(np.array([True]), np.zeros(2), 0.5).reshape(3, 12, 2)
    np.testing.assert_allclose(near.mean(axis=1)[0], (0.2, 0.0), atol=1e-9, err_msg="not before now")
    assert moving.outlines(np.array([False]), np.zeros(2), 0.25).shape == (0, 2)


def test_way_and_speed_with_an_acceleration_up_or_down_to_a_highest_speed() -> None:
    times = np.linspace(0.0, 4.0, 21)
    for speed_mps, most_mps in ((0.1, 0.4), (0.4, 0.1), (0.2, 0.2)):
        ways, speeds = Pace(speed_mps, 1.0, 0.3, 0.4, 0.26).ways(most_mps, times)
        change_s = abs(most_mps - speed_mps) / 0.3
        np.testing.assert_allclose(
            speeds, [speed_mps + (most_mps - speed_mps) * min(1.0, t / max(change_s, 1e-9)) for t in times]
        )
        end_m = change_s * (speed_mps + most_mps) / 2 + (4.0 - change_s) * most_mps
        assert ways[0] == 0.0 and ways[-1] == pytest.approx(end_m)
