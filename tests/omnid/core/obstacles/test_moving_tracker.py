"""Moving obstacles: a person who comes onto free floor, seen from a base that drives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles.moving_tracker import Arrivals, MovingObstacle, MovingTracker

S = 1_000_000_000
PERIOD_S = 0.2
NOT_NEARER = np.zeros(SECTORS, bool)


def arrived(x_m: float, people: list[tuple[float, float]], rng: np.random.Generator) -> np.ndarray:
    """Return the ranges of what has come, from a place on the x axis: people, discs of 0.2 m radius."""
    c, s = np.cos(azimuths()), np.sin(azimuths())
    ranges = np.full(SECTORS, np.nan)
    for px, py in people:
        along = (px - x_m) * c + py * s
        across2 = (px - x_m) ** 2 + py**2 - along**2
        hit = (along > 0) & (across2 < 0.04)
        ranges = np.where(hit, np.fmin(ranges, along - np.sqrt(np.maximum(0.04 - across2, 0))), ranges)
    return (ranges + 0.01 * ranges**2 * rng.standard_normal(SECTORS)).astype(np.float32)


def tracked(
    path: list[tuple[float, float]], speed_mps: float = 0.0, seed: int = 1, period_s: float = PERIOD_S
) -> list[tuple[MovingObstacle, ...]]:
    """Return the moving obstacles of a drive; path: the places of a person."""
    rng, tracker, found = np.random.default_rng(seed), MovingTracker(), []
    for i, place in enumerate(path):
        x_m = speed_mps * period_s * i
        ranges = arrived(x_m, [place], rng)
        T = se3.transform(np.eye(3), [x_m, 0, 0])
        found.append(tracker.update(round(i * period_s * S), T, Arrivals(ranges, 0.01 * ranges**2, NOT_NEARER)))
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


@pytest.mark.parametrize("seed", range(2))
def test_an_object_that_was_put_down_does_not_move(seed: int) -> None:
    found = tracked([(1.5, 0.8)] * 25, 0.3, seed)
    assert not any(found[5:])


@pytest.mark.hazard("H17")
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("speed_mps", [0.8, 1.2, 1.6])
def test_a_second_pair_shows_that_a_person_comes_and_a_third_how_fast(side: int, speed_mps: float) -> None:
    """Pairs at 10 Hz."""
    path = [(2.0, side * (1.8 - speed_mps * 0.1 * i)) for i in range(3)]
    found = tracked(path, 0.5, period_s=0.1)
    assert not found[0] and found[1] and found[1][0].vy_mps * side < -0.3 * speed_mps
    assert found[2][0].vy_mps * side == pytest.approx(-speed_mps, rel=0.4)


def test_a_person_who_hides_the_nearest_floor_in_view_does_not_seem_to_stop() -> None:
    """The ranges stay at 1 m while the person comes nearer; their sigma says that they are a bound."""
    tracker, rng = MovingTracker(), np.random.default_rng(1)
    for i in range(12):
        ranges = arrived(0.0, [(2.2 - 0.12 * i, 0.0)], rng)
        is_near = ranges < 1.0
        ranges = np.where(is_near, 1.0, ranges).astype(np.float32)
        sigma_m = np.where(is_near, 0.3, 0.01 * ranges**2).astype(np.float32)
        found = tracker.update(round(i * 0.1 * S), np.eye(4), Arrivals(ranges, sigma_m, is_near))
    assert found[0].vx_mps < -0.9


@pytest.mark.parametrize("side", [1, -1])
def test_a_person_nearer_than_all_floor_in_view_is_as_near_as_the_angle_says(side: int) -> None:
    """All floor in view, from 1.3 m on, is hidden over up to 60 degrees: 1.4 m there, a person 0.5 m away."""
    tracker, rng, speed_mps = MovingTracker(), np.random.default_rng(1), 1.2
    for i in range(16):
        y_m = side * (1.3 - speed_mps * 0.1 * i)
        ranges = np.where(np.isfinite(arrived(0.0, [(0.5, y_m)], rng)), np.float32(1.3), np.float32(np.nan))
        arrivals = Arrivals(ranges, 0.3 * ranges, np.isfinite(ranges))
        found = tracker.update(round(i * 0.1 * S), np.eye(4), arrivals)
        if i >= 6:
            assert len(found) == 1 and math.dist((found[0].x_m, found[0].y_m), (0.5, y_m)) < 0.25
            assert found[0].vy_mps * side == pytest.approx(-speed_mps, rel=0.35)


def test_a_person_who_comes_from_behind_another_has_a_new_track() -> None:
    """One walks away to a wall and stops there; the other one comes from there, 0.4 m beside, and is not the first."""
    rng, tracker, period_s = np.random.default_rng(1), MovingTracker(), 0.1
    found = []
    for i in range(30):
        first, second = (2.85, max(-0.3 - 1.5 * period_s * i, -1.9)), (3.2, -3.3 + 1.6 * period_s * i)
        ranges = arrived(0.0, [first, second] if second[1] > -1.55 else [first], rng)
        arrivals = Arrivals(ranges, 0.01 * ranges**2, NOT_NEARER)
        found.append((second, tracker.update(round(i * period_s * S), np.eye(4), arrivals)))
    seen = [(at, moving) for at, moving in found if -1.55 < at[1] < 1.0]
    for at, moving in seen[2:]:
        one = min(moving, key=lambda obstacle: math.dist((obstacle.x_m, obstacle.y_m), at))
        assert math.dist((one.x_m, one.y_m), at) < 0.35 and one.vy_mps > 0.5


def test_a_person_who_stops_is_no_longer_moving() -> None:
    found = tracked([(2.0, min(-2.0 + 0.8 * PERIOD_S * i, -0.5)) for i in range(40)])
    assert any(found[:12]) and not any(found[-8:])
