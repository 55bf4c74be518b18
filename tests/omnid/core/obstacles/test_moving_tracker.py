"""Moving obstacles: a person in a room of known walls, seen from a base that drives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles.moving_obstacle import MovingObstacle
from omnid.core.obstacles.moving_tracker import MovingTracker, surfaces

S = 1_000_000_000
PERIOD_S = 0.2
WALLS_M = 3.0  # a square room about the origin


def ring(x_m: float, people: list[tuple[float, float]], rng: np.random.Generator) -> np.ndarray:
    """Return the ring at a place in the room, people being discs of 0.2 m radius."""
    c, s = np.cos(azimuths()), np.sin(azimuths())
    with np.errstate(divide="ignore"):
        ranges = np.minimum((np.sign(c) * WALLS_M - x_m) / c, WALLS_M / np.abs(s))
    for px, py in people:
        along = (px - x_m) * c + py * s
        across2 = (px - x_m) ** 2 + py**2 - along**2
        hit = (along > 0) & (across2 < 0.04)
        ranges = np.where(hit, np.minimum(ranges, along - np.sqrt(np.maximum(0.04 - across2, 0))), ranges)
    return (ranges + 0.01 * ranges**2 * rng.standard_normal(SECTORS)).astype(np.float32)


def tracked(
    path: list[tuple[float, float]] | None, speed_mps: float = 0.0, seed: int = 1, steps: int = 25
) -> list[tuple[MovingObstacle, ...]]:
    """Return the moving obstacles of a drive; path: the places of a person."""
    rng, tracker, found = np.random.default_rng(seed), MovingTracker(), []
    for i in range(steps):
        x_m = speed_mps * PERIOD_S * i
        T = se3.transform(np.eye(3), [x_m, 0, 0])
        ranges = ring(x_m, [path[i]] if path else [], rng)
        found.append(tracker.update(round(i * PERIOD_S * S), T, ranges, (0.01 * ranges**2).astype(np.float32)))
    return found


@pytest.mark.parametrize("speed_mps", [0.0, 0.4])
def test_a_person_who_walks_is_tracked_with_velocity_and_covariance(speed_mps: float) -> None:
    path = [(2.0, -2.0 + 0.8 * PERIOD_S * i) for i in range(25)]
    found = tracked(path, speed_mps)
    times = [i for i, moving in enumerate(found) if moving]
    assert times and times[0] <= 6 and len(times) > 14
    inside = 0
    for i in times[3:]:
        one = min(found[i], key=lambda obstacle: math.dist((obstacle.x_m, obstacle.y_m), path[i]))
        # The middle of what is seen is that of the near side: up to a radius off.
        assert math.dist((one.x_m, one.y_m), path[i]) < 0.35
        assert abs(one.vx_mps) < 0.35 and one.vy_mps == pytest.approx(0.8, abs=0.35)
        inside += abs(one.vy_mps - 0.8) < 3 * math.sqrt(one.covariance[3, 3])
        assert np.linalg.eigvalsh(one.covariance).min() > 0 and 0.1 < one.radius_m < 0.4
    assert inside > 0.8 * len(times[3:])


@pytest.mark.parametrize("seed", range(5))
def test_a_room_that_stands_has_no_moving_obstacles(seed: int) -> None:
    assert sum(len(moving) for moving in tracked(None, 0.4, seed)) == 0
    assert sum(len(moving) for moving in tracked([(1.5, 0.8)] * 25, 0.3, seed)) == 0


def test_a_person_who_stops_is_no_longer_moving() -> None:
    path = [(2.0, min(-2.0 + 0.8 * PERIOD_S * i, -0.5)) for i in range(40)]
    found = tracked(path, steps=40)
    assert any(found[:12]) and not any(found[-8:])


def test_surfaces_are_joined_across_the_seam() -> None:
    ranges = np.full(SECTORS, np.nan, np.float32)
    ranges[[357, 358, 359, 0, 1]] = 2.0
    ranges[[100, 101, 103]] = 1.0
    ranges[104] = 3.0
    sigma = np.full(SECTORS, 0.01, np.float32)
    assert sorted(sectors.tolist() for sectors in surfaces(ranges, sigma)) == [
        [100, 101, 103],
        [104],
        [357, 358, 359, 0, 1],
    ]
    assert surfaces(np.full(SECTORS, np.nan, np.float32), sigma) == []
