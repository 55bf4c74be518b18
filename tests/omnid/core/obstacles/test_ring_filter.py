"""Ring over time: votes, and memory in odom."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles.free_space import CELL_M, END_M
from omnid.core.obstacles.observation import Observation
from omnid.core.obstacles.ring_filter import HIDING_M, RingFilter
from omnid.core.obstacles.settings import RingSettings

S = 1_000_000_000
SETTINGS = RingSettings()
AHEAD = np.abs(azimuths()) < np.deg2rad(15)
BEHIND = np.abs(azimuths()) > np.deg2rad(165)


def ring_of(range_m: float, where: np.ndarray = AHEAD, other: float = np.nan) -> Observation:
    """Return an observation with one range in some sectors."""
    ranges = np.where(where, range_m, other).astype(np.float32)
    return Observation(ranges, np.where(np.isfinite(ranges), 0.02, np.nan).astype(np.float32),
                       np.where(np.isfinite(ranges), ranges, 0).astype(np.float32))


def pose(x_m: float = 0.0, yaw_deg: float = 0.0) -> np.ndarray:
    """Return a pose in the plane."""
    return se3.transform(se3.rotation_exp([0, 0, np.deg2rad(yaw_deg)]), [x_m, 0, 0])


def test_an_obstacle_seen_once_is_unknown_and_seen_twice_is_there() -> None:
    ring = RingFilter(SETTINGS)
    assert np.isnan(ring.update(0, pose(), ring_of(2.0)).ranges_m[AHEAD]).all()
    np.testing.assert_allclose(ring.update(S // 5, pose(), ring_of(2.0)).ranges_m[AHEAD], 2.0, atol=1e-5)


def test_votes_are_for_the_same_place_in_odom() -> None:
    ring = RingFilter(SETTINGS)
    ring.update(0, pose(), ring_of(2.0))
    known = ring.update(S // 5, pose(0.5), ring_of(1.5)).ranges_m[AHEAD]
    assert np.isfinite(known).mean() > 0.9
    ring = RingFilter(SETTINGS)
    ring.update(0, pose(), ring_of(2.0))
    assert np.isnan(ring.update(S // 5, pose(0.5), ring_of(2.0)).ranges_m[AHEAD]).all()


def test_a_false_match_of_one_pair_never_becomes_an_obstacle() -> None:
    ring = RingFilter(SETTINGS)
    rng = np.random.default_rng(1)
    for i in range(30):
        seen = ring_of(3.0, np.ones(SECTORS, bool))
        seen.ranges_m[180] = rng.uniform(0.8, 2.5) if i % 5 == 0 else 3.0
        result = ring.update(i * S // 5, pose(), seen)
        if i > 2:
            known = result.ranges_m[np.isfinite(result.ranges_m)]
            np.testing.assert_allclose(known, 3.0, atol=1e-4)


def test_an_obstacle_that_becomes_too_near_is_remembered_and_follows_the_turns_of_the_base() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(3):
        ring.update(i * S // 5, pose(), ring_of(0.8))
    nothing = ring_of(np.nan)
    for i in range(3, 103):  # 20 s in which nothing is seen: far longer than memory_s
        x_m = min(0.3, 0.05 * (i - 2))
        result = ring.update(i * S // 5, pose(x_m), nothing)
    assert np.isfinite(result.ranges_m[AHEAD]).mean() > 0.9
    assert abs(float(np.nanmin(result.ranges_m)) - 0.5) < 0.02
    turned = ring.update(103 * S // 5, pose(0.3, 180), nothing)
    assert np.isfinite(turned.ranges_m[BEHIND]).mean() > 0.9 and np.isnan(turned.ranges_m[AHEAD]).all()


def test_an_obstacle_beyond_the_blind_zone_is_forgotten_after_memory_s() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(3):
        ring.update(i * S // 5, pose(), ring_of(2.0))
    nothing = ring_of(np.nan)
    last_seen_ns = 2 * S // 5
    until_ns = last_seen_ns + round(SETTINGS.memory_s * 1e9)
    assert np.isfinite(ring.update(until_ns - S // 10, pose(), nothing).ranges_m[AHEAD]).any()
    assert np.isnan(ring.update(until_ns + S // 10, pose(), nothing).ranges_m).all()


def test_an_obstacle_that_goes_away_is_forgotten_when_something_behind_it_is_seen() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(4):
        ring.update(i * S // 5, pose(), ring_of(0.7))
    for i in range(4, 9):
        result = ring.update(i * S // 5, pose(), ring_of(2.5))
    np.testing.assert_allclose(result.ranges_m[AHEAD], 2.5, atol=1e-5)


def test_clear_forgets() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(4):
        ring.update(i * S // 5, pose(), ring_of(0.7))
    ring.clear()
    assert np.isnan(ring.update(S, pose(), ring_of(np.nan)).ranges_m).all()


def test_without_votes_the_first_pair_counts() -> None:
    ring = RingFilter(replace(SETTINGS, min_votes=1))
    np.testing.assert_allclose(ring.update(0, pose(), ring_of(2.0)).ranges_m[AHEAD], 2.0, atol=1e-5)


def test_the_floor_that_was_seen_to_be_free_is_remembered_where_none_is_seen() -> None:
    ring = RingFilter(SETTINGS)
    floor = Observation(np.full(SECTORS, np.nan, np.float32), np.full(SECTORS, np.nan, np.float32),
                        np.full(SECTORS, 2.0, np.float32))
    nothing = ring_of(np.nan)
    ring.update(0, pose(), floor)
    near = ring.update(S, pose(1.5), nothing)
    np.testing.assert_allclose(near.free_m[AHEAD], 0.5 - END_M, atol=0.1)
    np.testing.assert_allclose(near.free_m[BEHIND][[0, -1]], 3.5 - END_M, atol=0.1)
    late = ring.update(S + round((SETTINGS.free_s + 1) * S), pose(1.5), nothing)
    assert (late.free_m <= CELL_M).all()


def test_a_floor_that_is_seen_now_says_more_than_the_memory() -> None:
    ring = RingFilter(SETTINGS)
    unknown = np.full(SECTORS, np.nan, np.float32)
    ring.update(0, pose(), Observation(unknown, unknown, np.full(SECTORS, 3.0, np.float32)))
    shorter = ring.update(S, pose(), Observation(unknown, unknown, np.full(SECTORS, 1.5, np.float32)))
    np.testing.assert_allclose(shorter.free_m, 1.5)


def test_a_long_drive_keeps_its_memory_of_the_free_floor_bounded_and_right() -> None:
    ring = RingFilter(SETTINGS)
    unknown = np.full(SECTORS, np.nan, np.float32)
    floor, nothing = np.full(SECTORS, 2.0, np.float32), np.zeros(SECTORS, np.float32)
    for i in range(200):  # 30 m, far beyond the square that is remembered
        ring.update(i * S // 5, pose(0.15 * i, 3 * i), Observation(unknown, unknown, floor))
    result = ring.update(40 * S, pose(0.15 * 199, 3 * 199), Observation(unknown, unknown, nothing))
    assert (result.free_m > 1.8).all() and (result.free_m < 5).all()


def test_a_direction_in_which_no_floor_was_ever_seen_is_not_free_by_its_neighbours() -> None:
    ring = RingFilter(SETTINGS)
    unknown = np.full(SECTORS, np.nan, np.float32)
    floor = np.where(AHEAD, 0.0, 2.0).astype(np.float32)
    for i in range(4):
        result = ring.update(i * S // 5, pose(), Observation(unknown, unknown, floor))
    assert result.free_m[175:185].max() <= 0.15


def floor_beside(degrees: float) -> Observation:
    """Return an observation of floor from 1.2 to 3 m all around, and of nothing in a sector ahead."""
    unknown = np.full(SECTORS, np.nan, np.float32)
    free = np.where(np.abs(azimuths()) < np.deg2rad(degrees / 2), 0.0, 3.0).astype(np.float32)
    return Observation(unknown, unknown, free, floor_from_m=1.2)


def test_what_hides_the_floor_and_shows_nothing_else_is_an_obstacle_until_the_floor_is_seen_again() -> None:
    ring = RingFilter(SETTINGS)
    assert np.isnan(ring.update(0, pose(), floor_beside(0)).ranges_m).all()
    assert np.isnan(ring.update(S // 10, pose(0.02), floor_beside(20)).ranges_m).all()
    someone = ring.update(S // 5, pose(0.05), floor_beside(20))
    np.testing.assert_allclose(someone.ranges_m[171:189], HIDING_M)
    assert np.isnan(someone.ranges_m[:170]).all() and (someone.free_m[171:189] == 0).all()
    assert np.isnan(ring.update(2 * S // 5, pose(0.1), floor_beside(0)).ranges_m).all()


def test_a_few_directions_without_floor_and_what_ended_the_floor_before_hide_nothing() -> None:
    ring = RingFilter(SETTINGS)
    ring.update(0, pose(), floor_beside(0))
    assert np.isnan(ring.update(S // 5, pose(0.05), floor_beside(5)).ranges_m).all()
    wall = RingFilter(SETTINGS)
    for x_m in np.arange(0.0, 2.5, 0.1):  # to a plain wall at 2.5 m; nearer than 1.2 m no floor is seen before it
        left_m = 2.5 - x_m
        seen = floor_beside(0)
        free = np.where(AHEAD, left_m if left_m > 1.2 else 0.0, seen.free_m).astype(np.float32)
        assert np.isnan(wall.update(round(x_m * 5 * S), pose(x_m), seen._replace(free_m=free)).ranges_m).all()


def test_where_the_base_stands_the_floor_that_cameras_cannot_see_counts_as_free_but_not_towards_a_near_wall() -> None:
    ring = RingFilter(SETTINGS)
    for minute in range(3):  # longer than the memory
        standing = ring.update(minute * 60 * S, pose(), floor_beside(40))
        np.testing.assert_allclose(standing.free_m[165:195], 1.2, atol=0.1)
    np.testing.assert_allclose(ring.update(121 * S, pose(0.5), floor_beside(40)).free_m[175:185], 0.7, atol=0.1)
    assert (RingFilter(SETTINGS).update(0, pose(), floor_beside(90)).free_m[175:185] <= CELL_M).all()


def test_floor_that_was_never_seen_is_not_free_while_the_base_drives() -> None:
    ring = RingFilter(SETTINGS)
    nothing = floor_beside(360)._replace(floor_from_m=np.inf)
    ring.update(0, pose(), nothing)
    assert (ring.update(S, pose(0.2), floor_beside(40)).free_m[175:185] <= 2 * CELL_M).all()


def test_a_few_directions_without_floor_are_as_free_as_those_beside_them() -> None:
    floor = floor_beside(0).free_m
    for missing, free in ((8, True), (20, False)):
        ring = RingFilter(SETTINGS)
        ring.update(0, pose(), floor_beside(360)._replace(floor_from_m=np.inf))
        seen = np.where(np.arange(SECTORS) // missing == 3, 0.0, floor).astype(np.float32)
        assert (ring.update(S, pose(0.2), floor_beside(0)._replace(free_m=seen)).free_m > 2.9).all() == free


def test_an_obstacle_too_near_for_stereo_is_not_farther_because_it_is_matched_wrongly() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(4):
        ring.update(i * S // 5, pose(0.1 * i), ring_of(1.0 - 0.1 * i))
    for i in range(4, 30):  # on to 0.4 m, where it seems to stay at 0.75 m
        near = ring.update(i * S // 5, pose(min(0.1 * i, 0.6)), ring_of(0.75))
    assert np.nanmax(near.ranges_m[175:185]) < 0.5
    for i in range(30, 34):
        gone = ring.update(i * S // 5, pose(0.6), ring_of(1.2))
    np.testing.assert_allclose(gone.ranges_m[AHEAD], 1.2, atol=1e-4)
    for i in range(4):
        ring.update(40 * S + i * S // 5, pose(0.6), ring_of(0.5))
    for i in range(4):
        late = ring.update(102 * S + i * S // 5, pose(0.6), ring_of(0.8))
    np.testing.assert_allclose(late.ranges_m[AHEAD], 0.8, atol=1e-4)


def test_memory_does_not_reach_through_somebody_who_has_come_and_shows_nothing() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(5):
        ring.update(i * S // 5, pose(), floor_beside(0))
    standing_m = 2.0  # from the start; hides the floor from there on
    for i in range(5, 45):
        x_m = min(0.05 * (i - 5), 1.5)
        left_m = standing_m - x_m
        free = np.where(AHEAD, left_m if left_m > 1.2 else 0.0, 3.0).astype(np.float32)
        seen = ring.update(i * S // 5, pose(x_m), floor_beside(0)._replace(free_m=free))
    assert seen.free_m[172:188].max() <= standing_m - 1.5 + CELL_M
