"""Ring over time: votes, and memory in odom."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles.floor_view import FloorView
from omnid.core.obstacles.free_space import CELL_M, END_M, MISSED_NS, ROBOT_M
from omnid.core.obstacles.observation import Observation, with_plane
from omnid.core.obstacles.ring_filter import RingFilter
from omnid.core.obstacles.settings import RingSettings
from tests.omnid.core.obstacles.drawn_floor import Pattern, Pillar, SeenFloor, blind, plain, tiles

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


def step(ring: RingFilter, stamp_ns: int, T_odom_base: np.ndarray, seen: Observation,
         view: Callable[[np.ndarray], FloorView] = blind) -> Observation:
    """Return the ring after a pair; cameras without a view of the floor show its memory."""
    return ring.update(stamp_ns, T_odom_base, seen, view)


def test_an_obstacle_seen_once_is_unknown_and_seen_twice_is_there() -> None:
    ring = RingFilter(SETTINGS)
    assert np.isnan(step(ring, 0, pose(), ring_of(2.0)).ranges_m[AHEAD]).all()
    np.testing.assert_allclose(step(ring, S // 5, pose(), ring_of(2.0)).ranges_m[AHEAD], 2.0, atol=1e-5)


def test_votes_are_for_the_same_place_in_odom() -> None:
    ring = RingFilter(SETTINGS)
    step(ring, 0, pose(), ring_of(2.0))
    known = step(ring, S // 5, pose(0.5), ring_of(1.5)).ranges_m[AHEAD]
    assert np.isfinite(known).mean() > 0.9
    ring = RingFilter(SETTINGS)
    step(ring, 0, pose(), ring_of(2.0))
    assert np.isnan(step(ring, S // 5, pose(0.5), ring_of(2.0)).ranges_m[AHEAD]).all()


def test_a_false_match_of_one_pair_never_becomes_an_obstacle() -> None:
    ring = RingFilter(SETTINGS)
    rng = np.random.default_rng(1)
    for i in range(30):
        seen = ring_of(3.0, np.ones(SECTORS, bool))
        seen.ranges_m[180] = rng.uniform(0.8, 2.5) if i % 5 == 0 else 3.0
        result = step(ring, i * S // 5, pose(), seen)
        if i > 2:
            known = result.ranges_m[np.isfinite(result.ranges_m)]
            np.testing.assert_allclose(known, 3.0, atol=1e-4)


def test_an_obstacle_that_becomes_too_near_is_remembered_and_follows_the_turns_of_the_base() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(3):
        step(ring, i * S // 5, pose(), ring_of(0.8))
    nothing = ring_of(np.nan)
    for i in range(3, 103):  # 20 s in which nothing is seen: far longer than memory_s
        x_m = min(0.3, 0.05 * (i - 2))
        result = step(ring, i * S // 5, pose(x_m), nothing)
    assert np.isfinite(result.ranges_m[AHEAD]).mean() > 0.9
    assert abs(float(np.nanmin(result.ranges_m)) - 0.5) < 0.02
    turned = step(ring, 103 * S // 5, pose(0.3, 180), nothing)
    assert np.isfinite(turned.ranges_m[BEHIND]).mean() > 0.9 and np.isnan(turned.ranges_m[AHEAD]).all()


def test_an_obstacle_beyond_the_blind_zone_is_forgotten_after_memory_s() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(3):
        step(ring, i * S // 5, pose(), ring_of(2.0))
    nothing = ring_of(np.nan)
    last_seen_ns = 2 * S // 5
    until_ns = last_seen_ns + round(SETTINGS.memory_s * 1e9)
    assert np.isfinite(step(ring, until_ns - S // 10, pose(), nothing).ranges_m[AHEAD]).any()
    assert np.isnan(step(ring, until_ns + S // 10, pose(), nothing).ranges_m).all()


def test_an_obstacle_that_goes_away_is_forgotten_when_something_behind_it_is_seen() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(4):
        step(ring, i * S // 5, pose(), ring_of(0.7))
    for i in range(4, 9):
        result = step(ring, i * S // 5, pose(), ring_of(2.5))
    np.testing.assert_allclose(result.ranges_m[AHEAD], 2.5, atol=1e-5)


def test_clear_forgets() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(4):
        step(ring, i * S // 5, pose(), ring_of(0.7))
    ring.clear()
    assert np.isnan(step(ring, S, pose(), ring_of(np.nan)).ranges_m).all()


def test_without_votes_the_first_pair_counts() -> None:
    ring = RingFilter(replace(SETTINGS, min_votes=1))
    np.testing.assert_allclose(step(ring, 0, pose(), ring_of(2.0)).ranges_m[AHEAD], 2.0, atol=1e-5)


def test_the_floor_that_was_seen_to_be_free_is_remembered_where_none_is_seen() -> None:
    ring = RingFilter(SETTINGS)
    floor = Observation(np.full(SECTORS, np.nan, np.float32), np.full(SECTORS, np.nan, np.float32),
                        np.full(SECTORS, 2.0, np.float32))
    nothing = ring_of(np.nan)
    step(ring, 0, pose(), floor)
    near = step(ring, S, pose(1.5), nothing)
    np.testing.assert_allclose(near.free_m[AHEAD], 0.5 - END_M, atol=0.1)
    np.testing.assert_allclose(near.free_m[BEHIND][[0, -1]], 3.5 - END_M, atol=0.1)
    late = step(ring, S + round((SETTINGS.free_s + 1) * S), pose(1.5), nothing)
    assert (late.free_m <= CELL_M).all()


def test_a_long_drive_keeps_its_memory_of_the_free_floor_bounded_and_right() -> None:
    ring = RingFilter(SETTINGS)
    unknown = np.full(SECTORS, np.nan, np.float32)
    floor, nothing = np.full(SECTORS, 2.0, np.float32), np.zeros(SECTORS, np.float32)
    for i in range(200):  # 30 m, far beyond the square that is remembered
        step(ring, i * S // 5, pose(0.15 * i, 3 * i), Observation(unknown, unknown, floor))
    result = step(ring, 40 * S, pose(0.15 * 199, 3 * 199), Observation(unknown, unknown, nothing))
    assert (result.free_m > 1.7).all() and (result.free_m < 5).all()


def test_a_direction_in_which_no_floor_was_ever_seen_is_not_free_by_its_neighbours() -> None:
    ring = RingFilter(SETTINGS)
    unknown = np.full(SECTORS, np.nan, np.float32)
    floor = np.where(AHEAD, 0.0, 2.0).astype(np.float32)
    for i in range(4):
        result = step(ring, i * S // 5, pose(), Observation(unknown, unknown, floor))
    assert result.free_m[175:185].max() <= 0.15


def floor_beside(degrees: float) -> Observation:
    """Return an observation of floor from 1.2 to 3 m all around, and of nothing in a sector ahead."""
    unknown = np.full(SECTORS, np.nan, np.float32)
    free = np.where(np.abs(azimuths()) < np.deg2rad(degrees / 2), 0.0, 3.0).astype(np.float32)
    return Observation(unknown, unknown, free, floor_from_m=1.2)


def test_where_the_base_stands_the_floor_that_cameras_cannot_see_counts_as_free_but_not_towards_a_near_wall() -> None:
    ring = RingFilter(SETTINGS)
    for minute in range(3):  # longer than the memory
        standing = step(ring, minute * 60 * S, pose(), floor_beside(40))
        np.testing.assert_allclose(standing.free_m[165:195], 1.2, atol=0.1)
    np.testing.assert_allclose(step(ring, 121 * S, pose(0.5), floor_beside(40)).free_m[175:185], 0.7, atol=0.1)
    assert (step(RingFilter(SETTINGS), 0, pose(), floor_beside(90)).free_m[175:185] <= CELL_M).all()


def test_floor_that_was_never_seen_is_not_free_while_the_base_drives() -> None:
    ring = RingFilter(SETTINGS)
    nothing = floor_beside(360)._replace(floor_from_m=np.inf)
    step(ring, 0, pose(), nothing)
    assert (step(ring, S, pose(0.2), floor_beside(40)).free_m[175:185] <= 2 * CELL_M).all()


def test_an_obstacle_too_near_for_stereo_is_not_farther_because_it_is_matched_wrongly() -> None:
    ring = RingFilter(SETTINGS)
    for i in range(4):
        step(ring, i * S // 5, pose(0.1 * i), ring_of(1.0 - 0.1 * i))
    for i in range(4, 30):  # on to 0.4 m, where it seems to stay at 0.75 m
        near = step(ring, i * S // 5, pose(min(0.1 * i, 0.6)), ring_of(0.75))
    assert np.nanmax(near.ranges_m[175:185]) < 0.5
    for i in range(30, 34):
        gone = step(ring, i * S // 5, pose(0.6), ring_of(1.2))
    np.testing.assert_allclose(gone.ranges_m[AHEAD], 1.2, atol=1e-4)
    for i in range(4):
        step(ring, 40 * S + i * S // 5, pose(0.6), ring_of(0.5))
    for i in range(4):
        late = step(ring, 102 * S + i * S // 5, pose(0.6), ring_of(0.8))
    np.testing.assert_allclose(late.ranges_m[AHEAD], 0.8, atol=1e-4)




NOTHING = ring_of(np.nan)
PERIOD_NS = S // 10


class Drive:
    """Pairs of a drive along x at 10 Hz over a floor that stereo sees up to 3 m, or not at all."""

    def __init__(self, floor: SeenFloor, settings: RingSettings = SETTINGS) -> None:
        self.floor, self.ring, self.x_m, self.stamp_ns = floor, RingFilter(settings), 0.0, 0

    def go(self, pairs: int, stereo: Observation, speed_mps: float = 0.0) -> Observation:
        """Return the ring after so many pairs."""
        for _ in range(pairs):
            self.stamp_ns += PERIOD_NS
            self.x_m += speed_mps * PERIOD_NS / S
            T = pose(self.x_m)
            seen = step(self.ring, self.stamp_ns, T, stereo, self.floor.at(T))
        return seen


@pytest.mark.parametrize("pattern", [tiles, plain])
def test_floor_that_stereo_does_not_see_again_stays_free_as_long_as_it_looks_the_same(pattern: Pattern) -> None:
    drive = Drive(SeenFloor(pattern))
    drive.go(3, floor_beside(0))
    assert drive.go(40, NOTHING, 0.3).free_m[AHEAD].min() > 1.2
    drive.floor.gain = 1.4  # another exposure
    assert drive.go(40, NOTHING).free_m[AHEAD].min() > 1.2
    drive.floor.noise_grey = 60.0  # too dark to compare anything
    assert drive.go(MISSED_NS // PERIOD_NS + 3, NOTHING).free_m[AHEAD].max() < 1.0


def test_what_stereo_does_not_see_ends_the_free_floor_at_its_foot_until_it_goes() -> None:
    drive = Drive(SeenFloor())
    drive.go(3, floor_beside(0))
    drive.floor.pillars = [Pillar(1.5, 0.0, 0.25)]
    hidden = drive.go(1, NOTHING)
    assert hidden.free_m[173:187].max() <= 1.3 and hidden.free_m[173:187].min() > 1.0
    assert np.isnan(hidden.ranges_m).all()
    np.testing.assert_allclose(hidden.free_m[BEHIND], 3.0 - END_M, atol=0.1)
    drive.go(20, NOTHING, 0.3)
    assert drive.go(1, floor_beside(0)).free_m[175:185].max() <= 1.3 - 0.6 + CELL_M, "stereo passes over a gap"
    drive.floor.pillars = []
    assert drive.go(2, floor_beside(0)).free_m[AHEAD].min() > 2.5


def test_memory_farther_than_floor_is_compared_does_not_reach_through_what_has_come_there() -> None:
    drive = Drive(SeenFloor())
    drive.go(3, floor_beside(0)._replace(free_m=np.full(SECTORS, 4.0, np.float32)))
    drive.floor.pillars = [Pillar(3.2, 0.0, 0.25)]
    drive.go(MISSED_NS // PERIOD_NS + 1, NOTHING, 0.8)
    for _ in range(8):
        seen = drive.go(1, NOTHING, 0.8)
        assert seen.free_m[176:184].max() < 3.2 - 0.25 - drive.x_m + CELL_M


def test_behind_what_has_come_no_range_is_known() -> None:
    drive = Drive(SeenFloor())
    ranges = np.where(AHEAD, 2.8, np.nan).astype(np.float32)
    wall = floor_beside(0)._replace(ranges_m=ranges, sigma_m=np.where(AHEAD, 0.02, np.nan).astype(np.float32))
    np.testing.assert_allclose(drive.go(4, wall).ranges_m[AHEAD], 2.8, atol=0.01)
    drive.floor.pillars = [Pillar(1.5, 0.0, 0.25)]
    assert np.isnan(drive.go(1, NOTHING).ranges_m[173:187]).all()
    beyond = NOTHING._replace(ranges_m=np.full(SECTORS, np.inf, np.float32))
    assert np.isnan(drive.go(1, beyond).ranges_m[173:187]).all()
    someone = drive.go(3, wall._replace(ranges_m=np.where(AHEAD, 1.35, np.nan).astype(np.float32)))
    np.testing.assert_allclose(someone.ranges_m[AHEAD], 1.35, atol=0.01)


def test_what_covers_the_nearest_floor_in_view_may_stand_nearer_unless_the_ring_has_it() -> None:
    near = Pillar(0.55, 0.0, 0.2)
    drive = Drive(SeenFloor())
    drive.go(3, floor_beside(0))
    drive.floor.pillars = [near]
    assert drive.go(1, NOTHING).free_m[173:187].max() <= ROBOT_M + CELL_M
    drive.floor.pillars = []
    assert drive.go(1, NOTHING).free_m[173:187].min() > 2.0
    box = Drive(SeenFloor())
    box.go(3, floor_beside(0))
    box.floor.pillars = [near]
    assert box.go(2, NOTHING).free_m[173:187].max() <= ROBOT_M + CELL_M
    for stereo in (ring_of(0.6), NOTHING):
        np.testing.assert_allclose(box.go(2, stereo).free_m[175:185], 0.6, atol=0.06)
        np.testing.assert_allclose(box.go(1, stereo).ranges_m[175:185], 0.6, atol=0.01)


def test_what_covers_the_floor_beside_a_near_obstacle_is_its_side() -> None:
    drive = Drive(SeenFloor())
    drive.go(3, floor_beside(0))
    half = np.asarray((azimuths() > -0.3) & (azimuths() < -0.05))
    drive.go(3, ring_of(0.6, half))
    drive.floor.pillars = [Pillar(0.55, 0.0, 0.2)]
    covered = drive.go(4, ring_of(0.6, half)).free_m[178:187]
    np.testing.assert_allclose(covered, 0.6 - END_M, atol=CELL_M)


def test_a_range_behind_the_nearest_floor_shows_that_nothing_stands_before_it() -> None:
    drive = Drive(SeenFloor())
    drive.go(3, floor_beside(0))
    wall = ring_of(2.0)
    drive.go(3, wall)
    drive.floor.pillars = [Pillar(0.55, 0.0, 0.2)]
    seen = drive.go(3, wall).free_m[175:185]
    assert seen.min() > 0.7 and seen.max() < 1.0, "its floor looks otherwise, but not up to the base"
    assert drive.go(1, NOTHING).free_m[175:185].max() <= ROBOT_M + CELL_M, "a remembered wall is not seen"


def test_what_is_passed_by_covers_the_floor_from_where_it_stands() -> None:
    drive = Drive(SeenFloor())
    drive.floor.pillars = [Pillar(1.5, -0.6, 0.1)]
    bearing = np.arctan2(-0.6, 1.5)
    free = np.where(np.abs(azimuths() - bearing) < np.deg2rad(5), 1.3, 3.0).astype(np.float32)
    drive.go(3, floor_beside(0)._replace(free_m=free))
    beside = drive.go(50, NOTHING, 0.3)
    assert 1.4 < drive.x_m < 1.6
    right = beside.free_m[85:95]
    assert right.max() < 0.8 and right.min() > 0.3, "not up to the base"


def test_what_stands_behind_the_nearest_floor_in_view_closes_no_nearer_floor() -> None:
    drive = Drive(SeenFloor())
    drive.go(3, floor_beside(0))
    drive.floor.pillars = [Pillar(1.12, 0.0, 0.2)]
    seen = drive.go(5, NOTHING).free_m[175:185]
    assert seen.max() <= 0.92 + CELL_M and seen.min() > 0.7


def test_floor_that_was_hidden_for_longer_than_memory_is_learned_again() -> None:
    drive = Drive(SeenFloor())
    drive.go(3, floor_beside(0))
    drive.floor.pattern = lambda x, y: np.where(x > 0.5, 60.0, tiles(x, y))  # a shadow that stays
    assert drive.go(10, floor_beside(0)).free_m[175:185].max() < 1.0
    drive.stamp_ns += round(SETTINGS.free_s * S)
    assert drive.go(2, floor_beside(0)).free_m[AHEAD].min() > 2.5


def test_a_shadow_hides_no_floor_that_both_cameras_see_as_a_plane() -> None:
    drive = Drive(SeenFloor())
    drive.go(3, floor_beside(0))
    drive.floor.pattern = lambda x, y: np.where(x > 0.5, 60.0, tiles(x, y))
    plane = with_plane(NOTHING, np.where(azimuths() > 0.1, 2.0, 0.0))
    shadow = drive.go(5, plane)
    assert shadow.free_m[192:200].min() > 1.9 and shadow.free_m[168:178].max() < 1.0


def test_assumed_floor_in_view_is_not_kept_by_its_looks() -> None:
    drive = Drive(SeenFloor(plain))
    np.testing.assert_allclose(drive.go(3, floor_beside(40)).free_m[175:185], 1.2, atol=0.1)
    away = drive.go(30, floor_beside(40), 0.05)
    assert drive.x_m > 0.09 and away.free_m[175:185].max() <= 0.8 + CELL_M


def test_a_change_of_brightness_below_the_setting_hides_nothing_and_none_is_compared_at_0() -> None:
    for change_grey, free_m in ((40.0, 2.85), (8.0, 1.05), (0.0, 2.85)):
        drive = Drive(SeenFloor(plain), replace(SETTINGS, change_grey=change_grey))
        drive.go(3, floor_beside(0))
        drive.floor.pillars = [Pillar(1.3, 0.0, 0.25, grey=145.0)]
        np.testing.assert_allclose(drive.go(1, NOTHING).free_m[177:183], free_m, atol=0.15)
    assert drive.go(MISSED_NS // PERIOD_NS + 1, NOTHING).free_m[177:183].max() < 0.9
