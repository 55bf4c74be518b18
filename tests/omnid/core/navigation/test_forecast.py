"""Moving obstacles on a path."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from omnid.core.navigation.forecast import Forecast, Pace, yielding
from tests.omnid.core.navigation.test_moving_people import at


def test_a_fast_one_from_the_side_is_not_taken_for_one_from_behind() -> None:
    path = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
    pace = Pace(0.4, 0.4, 0.3, 0.4, 0.26)
    share, coming = yielding(path, 4.0, at(-0.5, 0.9, 2.0, -0.8), pace)
    assert share < 1.0 and not coming[0], "119 degrees from the direction of the path"
    assert yielding(path, 4.0, at(-0.57, 0.9, 2.0, -0.8), pace).share == 1.0, "122 degrees"


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


def test_who_stands_before_the_base_and_begins_to_walk_away_does_not_come() -> None:
    pace = Pace(0.0, 0.4, 0.3, 0.4, 0.26)
    path = np.column_stack([np.arange(0.0, 4.0, 0.05), np.zeros(80)])
    share, coming = yielding(path, 4.0, at(0.3, 0.0, 0.1, 0.0), pace)
    assert share == 0.0 and not coming[0]
