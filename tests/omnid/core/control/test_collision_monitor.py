"""The collision monitor: polygons, time to collision, unknown directions, old scans, moving obstacles."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from omnid.core.control import collision_monitor as monitor_module
from omnid.core.control.collision_geometry import MOST_MOTIONS
from omnid.core.control.collision_monitor import (
    UNKNOWN_SECTORS,
    CollisionMonitor,
    CollisionSettings,
    ControllerScan,
    MovingPoint,
    unknown_ends,
)
from omnid.core.control.heading_controller import Twist

S = 1_000_000_000
SETTINGS = CollisionSettings()
FREE_SCAN = (math.inf,) * 360
AHEAD = Twist(0.5)


def sector(azimuth_deg: float) -> int:
    """Return the sector of an azimuth."""
    return int((azimuth_deg + 180) % 360)


def with_points(*points: tuple[float, float], rest: float = math.inf) -> tuple[float, ...]:
    """Return the ranges of a scan with obstacles at points, 3 degrees wide."""
    ranges = [rest] * 360
    for x, y in points:
        for shift in (-1, 0, 1):
            k = (sector(math.degrees(math.atan2(y, x))) + shift) % 360
            ranges[k] = math.hypot(x, y)
    return tuple(ranges)


def with_unknown(low_deg: float, high_deg: float, rest: float = math.inf) -> tuple[float, ...]:
    """Return the ranges of a scan of which a part is unknown."""
    return tuple(math.nan if low_deg <= k - 179.5 <= high_deg else rest for k in range(360))


def after(
    ranges: tuple[float, ...],
    motion: Twist = AHEAD,
    settings: CollisionSettings = SETTINGS,
    *,
    free: tuple[float, ...] = (),
    moving: tuple[MovingPoint, ...] = (),
    age_s: float = 0.1,
    unwatched: tuple[bool, ...] = (),
) -> tuple[Twist, str]:
    """Return the allowed motion and the reason, before a new scan."""
    monitor = CollisionMonitor(settings, 1.5)
    monitor.set_scan(ControllerScan(10 * S, ranges, free, moving, unwatched))
    allowed = monitor.step(10 * S + round(age_s * S), motion)
    return allowed, monitor.reason


def test_free_is_free() -> None:
    for motion in (AHEAD, Twist(-0.5), Twist(0.0, 1.0), Twist(0.3, -0.8)):
        assert after(FREE_SCAN, motion) == (motion, "")


@pytest.mark.hazard("H16")
@pytest.mark.parametrize("point", [(0.39, 0.0), (0.3, 0.2), (0.26, -0.1), (0.2, 0.0)])
def test_stops_before_an_obstacle_in_the_stop_polygon_and_lets_the_base_back_out(point: tuple[float, float]) -> None:
    assert after(with_points(point)) == (Twist(), monitor_module.BLOCKED)
    allowed, _ = after(with_points(point), Twist(-0.3))
    assert allowed == Twist(-0.3)
    assert after(with_points((-point[0], point[1])), Twist(-0.3)) == (Twist(), monitor_module.BLOCKED)


@pytest.mark.hazard("H16")
@pytest.mark.parametrize("distance_m", [0.5, 0.8, 1.1])
def test_the_speed_is_the_distance_by_the_time_to_collision(distance_m: float) -> None:
    settings = replace(SETTINGS, slow_m=0.0)
    allowed, reason = after(with_points((distance_m, 0.0)), AHEAD, settings)
    expected = (distance_m - settings.front_m - settings.stop_m) / settings.time_s
    assert allowed.velocity_mps == pytest.approx(min(0.5, expected), rel=0.01) and (reason == monitor_module.NEAR) == (
        expected < 0.5
    )


def test_a_stopped_base_does_not_creep_on_when_the_scan_changes_by_a_cell() -> None:
    monitor = CollisionMonitor(replace(SETTINGS, slow_m=0.0), 1.5)
    speeds, reasons = [], []
    for n, distance_m in enumerate((0.5, 0.44, 0.41, 0.46, 0.41, 0.46, 0.6, 0.46)):
        monitor.set_scan(ControllerScan((10 + n) * S, with_points((distance_m, 0.0))))
        speeds.append(monitor.step((10 + n) * S, AHEAD).velocity_mps)
        reasons.append(monitor.reason)
    assert [speed > 0 for speed in speeds] == [True, True, False, False, False, False, True, True]
    assert reasons[2:6] == [monitor_module.BLOCKED] * 4
    assert monitor.step(17 * S, Twist(0.0, 1.0)) == Twist(0.0, 1.0)


def test_a_stopped_base_obeys_another_direction_and_a_slow_command() -> None:
    monitor = CollisionMonitor(replace(SETTINGS, slow_m=0.0), 1.5)
    for distance_m, motion, moves in (
        (0.405, AHEAD, False),
        (0.44, AHEAD, False),
        (0.44, Twist(0.03), True),
        (0.405, AHEAD, False),
        (0.44, Twist(-0.4), True),
    ):
        monitor.set_scan(ControllerScan(10 * S, with_points((distance_m, 0.0))))
        assert (monitor.step(10 * S, motion).velocity_mps != 0) == moves


def test_a_base_that_stands_needs_no_scan() -> None:
    monitor = CollisionMonitor(SETTINGS, 1.5)
    assert (monitor.step(S, Twist()), monitor.reason) == (Twist(), "")
    assert (monitor.step(S, Twist(1.0)), monitor.reason) == (Twist(), monitor_module.SCAN_STALE)


@pytest.mark.hazard("H16")
def test_drives_slowly_past_what_is_beside_its_way() -> None:
    allowed, reason = after(with_points((0.6, 0.3)))
    assert allowed.velocity_mps == pytest.approx(SETTINGS.slow_mps) and reason == monitor_module.NEAR
    assert after(with_points((0.6, 0.5))) == (AHEAD, "")
    assert after(with_points((-0.6, 0.3))) == (AHEAD, "")


@pytest.mark.hazard("H16")
def test_an_arc_is_judged_on_the_arc() -> None:
    # On an arc of 0.5 m to the left the base meets what is ahead on the left, not what is straight ahead.
    arc, point = Twist(0.3, 0.6), (0.45, 0.62)
    settings = replace(SETTINGS, slow_m=0.0, time_s=3.0)
    assert after(with_points(point), arc, settings)[0].velocity_mps < 0.29
    assert after(with_points(point), Twist(0.3), settings)[0] == Twist(0.3)
    allowed, _ = after(with_points(point), arc, settings)
    assert allowed.yaw_rate_radps / allowed.velocity_mps == pytest.approx(2.0)


def test_turns_on_the_spot_unless_a_corner_would_touch() -> None:
    turn = Twist(0.0, -0.5)
    assert after(with_points((0.38, 0.0)), turn)[0] == turn
    assert after(with_points((0.27, 0.2)), turn)[0].yaw_rate_radps > -0.3


@pytest.mark.hazard("H19")
def test_a_long_base_turns_on_the_spot_as_far_as_floor_was_seen_beside_it() -> None:
    """A plain wall 0.55 m to its left, which its front reaches; one that may be at its side already is no reason."""
    settings, turn = replace(SETTINGS, front_m=0.6), Twist(0.0, 0.5)
    free = tuple(0.55 if math.isnan(range_m) else 6.0 for range_m in with_unknown(20, 160))
    for ranges in (with_unknown(20, 160), (4.0,) * 360):  # nothing is seen behind it, or another wall, past a pole
        allowed, reason = after(ranges, turn, settings, free=free)
        assert 0.0 < allowed.yaw_rate_radps < 0.3 and reason == monitor_module.UNKNOWN
        assert after(ranges, turn, SETTINGS, free=free) == (turn, "")
    assert after(with_unknown(20, 160), turn, settings) == (turn, "")
    slow = after(with_unknown(20, 160), turn, replace(settings, unknown="slow", slow_mps=0.2), free=free)[0]
    assert slow.yaw_rate_radps == pytest.approx(0.2 / math.hypot(0.6, 0.22))


def test_where_a_base_may_not_drive_it_may_turn_to_a_heading() -> None:
    monitor, arc = CollisionMonitor(SETTINGS, 1.5), Twist(0.3, -0.5)
    monitor.set_scan(ControllerScan(10 * S, with_points((0.38, 0.0))))
    assert monitor.step(10 * S, arc) == Twist()
    assert monitor.step(10 * S, arc, to_heading=True) == Twist(0.0, -0.5)
    assert (monitor.share, monitor.reason) == (0.0, monitor_module.BLOCKED)
    # A corner that would touch something keeps it from turning, as ever, and so does a scan that is stale.
    monitor.set_scan(ControllerScan(11 * S, with_points((0.38, 0.0), (0.27, 0.2))))
    assert abs(monitor.step(11 * S, arc, to_heading=True).yaw_rate_radps) < 0.3
    assert monitor.step(15 * S, arc, to_heading=True) == Twist()


@pytest.mark.hazard("H19")
def test_an_unknown_way_is_approached_slowly_or_not_at_all() -> None:
    wall = with_unknown(-20, 20)
    assert after(wall) == (Twist(), monitor_module.UNKNOWN)
    allowed, reason = after(wall, settings=replace(SETTINGS, unknown="slow"))
    assert allowed.velocity_mps == pytest.approx(SETTINGS.slow_mps) and reason == monitor_module.UNKNOWN
    assert after(wall, settings=replace(SETTINGS, unknown="ignore")) == (AHEAD, "")
    assert after(wall, Twist(-0.5)) == (Twist(-0.5), "")


def test_an_unknown_way_that_was_seen_to_be_free_is_driven_up_to_there() -> None:
    wall = with_unknown(-20, 20)
    assert after(wall, free=(2.0,) * 360) == (AHEAD, "")
    for unknown in ("stop", "slow"):
        settings = replace(SETTINGS, unknown=unknown)
        allowed, _ = after(wall, free=(0.8,) * 360, settings=settings)
        assert allowed.velocity_mps == pytest.approx(0.37 / settings.time_s, rel=0.1)
        slowest = Twist() if unknown == "stop" else Twist(settings.slow_mps, 0.0)
        assert after(wall, free=(0.4,) * 360, settings=settings) == (slowest, monitor_module.UNKNOWN)


@pytest.mark.hazard("H19")
def test_a_wall_that_is_seen_past_an_unknown_place_makes_it_no_freer() -> None:
    """As behind a plain pole; beside a wall the floor is often seen to be free not quite as far as it."""
    for sectors, free_m, is_unknown in ((8, 0.4, True), (4, 0.4, False), (8, 2.9, False)):
        free = tuple(free_m if abs(k - 179.5) < sectors / 2 else 3.0 for k in range(360))
        assert (after((3.0,) * 360, free=free)[1] == monitor_module.UNKNOWN) == is_unknown
        assert (after((3.0,) * 360, Twist(-0.5), free=(*free[180:], *free[:180]))[0] == Twist(-0.5)) != is_unknown


@pytest.mark.hazard("H19")
def test_a_place_beside_before_which_a_wall_is_seen_does_not_keep_a_base_from_turning() -> None:
    """A person there would hide the wall."""
    free = tuple(0.0 if -150 < k - 179.5 < -100 else 3.0 for k in range(360))
    swings = Twist(0.3, 0.6)
    assert after((3.0,) * 360, swings, free=free) == (swings, "")
    assert after(with_unknown(-150, -100), swings, free=free) == (Twist(), monitor_module.UNKNOWN)


@pytest.mark.hazard("H19")
@pytest.mark.parametrize(("yaw_rate_radps", "goes_on"), [(0.0, True), (0.05, True), (-0.05, True), (0.2, False)])
def test_a_base_drives_along_what_is_unknown_beside_it(yaw_rate_radps: float, goes_on: bool) -> None:
    """A corrected heading takes a corner nearer by a little; a turn into it is another thing, and so is an obstacle."""
    motion = Twist(0.5, yaw_rate_radps)
    for way in (1, -1):
        beside, turned = with_unknown(45, 135), Twist(way * 0.5, motion.yaw_rate_radps)
        assert (after(beside, turned) == (turned, "")) == goes_on
    near, slow = with_points((0.1, 0.24), (-0.1, 0.24)), Twist(0.15, 0.3 * yaw_rate_radps)
    assert (after(near, slow) == (slow, "")) == (yaw_rate_radps == 0.0)


@pytest.mark.hazard("H22")
@pytest.mark.parametrize("policy", ["stop", "slow", "ignore"])
@pytest.mark.parametrize("unknown", ["stop", "ignore"])
def test_towards_dead_and_blind_parts_of_the_images_counts_as_without_a_fresh_scan(policy: str, unknown: str) -> None:
    """The setting for them is `stale`, not `unknown`: something may have come there."""
    ranges, settings = with_unknown(-30, 30), replace(SETTINGS, stale=policy, unknown=unknown)
    unwatched = tuple(math.isnan(range_m) for range_m in ranges)
    expected_mps = {"stop": 0.0, "slow": SETTINGS.slow_mps, "ignore": 0.5}[policy]
    allowed, reason = after(ranges, settings=settings, unwatched=unwatched)
    assert allowed.velocity_mps == pytest.approx(expected_mps)
    assert reason == ("" if policy == "ignore" else monitor_module.UNWATCHED)
    for away in (Twist(-0.5), Twist(0.0, 1.0)):
        assert after(ranges, away, settings, unwatched=unwatched) == (away, "")


@pytest.mark.hazard("H23")
def test_in_the_dark_the_base_does_not_even_turn() -> None:
    """Directions that are unknown because they are plain do not keep a base from turning away; no image at all does."""
    ranges, turn = (math.nan,) * 360, Twist(0.0, 1.0)
    assert after(ranges, turn) == (turn, "")
    assert after(ranges, turn, unwatched=(True,) * 360) == (Twist(), monitor_module.UNSEEN)
    assert monitor_module.remedy(monitor_module.UNSEEN) == monitor_module.IMAGES_REMEDY
    assert monitor_module.remedy(monitor_module.SCAN_STALE) == monitor_module.SCAN_REMEDY
    assert monitor_module.remedy(monitor_module.BLOCKED) == monitor_module.REMEDY


@pytest.mark.hazard("H21")
@pytest.mark.parametrize(("stale", "expected_mps"), [("stop", 0.0), ("slow", SETTINGS.slow_mps), ("ignore", 0.5)])
def test_a_stale_scan_and_a_missing_one_stop_the_base(stale: str, expected_mps: float) -> None:
    settings = replace(SETTINGS, stale=stale)
    allowed, reason = after(FREE_SCAN, settings=settings, age_s=settings.stale_s + 0.01)
    assert allowed.velocity_mps == pytest.approx(expected_mps)
    assert reason == ("" if stale == "ignore" else monitor_module.SCAN_STALE)
    missing = CollisionMonitor(settings, 1.5)
    assert missing.step(S, AHEAD).velocity_mps == pytest.approx(expected_mps)


@pytest.mark.hazard("H20")
@pytest.mark.parametrize("age_s", [0.1, 0.2, 0.3, 0.4, 0.5])
@pytest.mark.parametrize("speed_mps", [0.6, -0.6, 1.5])
def test_an_older_scan_makes_the_base_no_freer(age_s: float, speed_mps: float) -> None:
    """The end of the floor that was in front of the base is inside its outline by now, or behind it."""
    nothing_ahead = tuple(0.0 if abs(abs(k - 179.5) - 180 * (speed_mps < 0)) < 60 else 6.0 for k in range(360))
    ranges = tuple(math.nan if free == 0.0 else math.inf for free in nothing_ahead)
    for unwatched in ((), tuple(free == 0.0 for free in nothing_ahead)):
        monitor = CollisionMonitor(SETTINGS, 1.5)
        monitor.set_scan(ControllerScan(10 * S, ranges, nothing_ahead, unwatched=unwatched))
        for tick in range(round(20 * age_s)):
            monitor.follow(10 * S + tick * S // 20, Twist(speed_mps))
        now_ns = 10 * S + round(age_s * S)
        assert monitor.step(now_ns, Twist(speed_mps)) == Twist()
        if age_s * abs(speed_mps) < SETTINGS.front_m:
            assert monitor.step(now_ns, Twist(-speed_mps)) == Twist(-speed_mps), "it may back out"


@pytest.mark.hazard("H20")
def test_a_scan_from_before_all_motions_that_are_remembered_is_stale() -> None:
    monitor = CollisionMonitor(replace(SETTINGS, stale_s=10.0), 1.5)
    monitor.set_scan(ControllerScan(10 * S, FREE_SCAN))
    for tick in range(MOST_MOTIONS + 1):
        assert monitor.step(10 * S + tick * S // 200, Twist(0.2)) == Twist(0.2)
        monitor.follow(10 * S + tick * S // 200, Twist(0.2))
    assert monitor.step(12 * S + S // 100, Twist(0.2)) == Twist()
    assert monitor.reason == monitor_module.SCAN_STALE


def test_is_off_when_it_is_off() -> None:
    off = replace(SETTINGS, check=False)
    assert after(with_points((0.3, 0.0)), settings=off, age_s=9.0) == (AHEAD, "")


@pytest.mark.hazard("H17")
def test_a_person_who_comes_from_the_side_stops_the_base_and_one_who_leaves_does_not() -> None:
    crossing = MovingPoint(0.9, 0.9, 0.0, -1.0, 0.25)
    allowed, reason = after(FREE_SCAN, moving=(crossing,))
    assert allowed.velocity_mps < 0.35 and reason == monitor_module.MOVING
    assert after(FREE_SCAN, moving=(crossing._replace(y_m=1.8, vy_mps=1.0),)) == (AHEAD, "")
    near = MovingPoint(0.9, 0.0, -1.0, 0.0, 0.25)
    assert after(FREE_SCAN, moving=(near,)) == (Twist(), monitor_module.MOVING)


@pytest.mark.hazard("H17")
def test_a_new_one_slows_the_base_down_where_it_may_go() -> None:
    """Seen twice, it seems to walk beside the way; three looks make the sigma smaller than 0.4 m/s."""
    new = MovingPoint(1.0, 1.6, 0.0, -0.1, 0.2, 0.1, 0.6)
    allowed, reason = after(FREE_SCAN, moving=(new,))
    assert allowed.velocity_mps == pytest.approx(0.4) and reason == monitor_module.MOVING
    assert after(FREE_SCAN, moving=(new._replace(sigma_mps=0.3),)) == (AHEAD, "")
    assert after(FREE_SCAN, moving=(new._replace(y_m=3.0),)) == (AHEAD, "")


def test_never_gives_more_than_was_asked_nor_another_direction() -> None:
    rng = random.Random(3)
    reasons = set()
    for _ in range(2000):
        ranges = rng.choice(
            (
                with_unknown(-20, 20),
                with_points((rng.uniform(-2, 2), rng.uniform(-2, 2))),
                tuple(rng.choice((math.inf, math.nan, rng.uniform(0.05, 3.0))) for _ in range(360)),
            )
        )
        moving = tuple(MovingPoint(*(rng.uniform(-2, 2) for _ in range(4)), 0.2) for _ in range(rng.randrange(3)))
        motion = Twist(rng.uniform(-1, 1), rng.uniform(-2, 2))
        allowed, reason = after(ranges, motion, moving=moving, age_s=rng.uniform(-0.2, 1.0))
        share = allowed.velocity_mps / motion.velocity_mps
        assert 0.0 <= share <= 1.0 and allowed.yaw_rate_radps == pytest.approx(share * motion.yaw_rate_radps)
        assert (share == 1.0) == (reason == "")
        reasons.add(reason)
    assert len(reasons) == 6


@pytest.mark.parametrize("stamp_ns", [11 * S, 10**6 * S, math.nan])
def test_a_scan_of_the_future_or_of_no_time_is_stale(stamp_ns: float) -> None:
    monitor = CollisionMonitor(SETTINGS, 1.5)
    monitor.set_scan(ControllerScan(stamp_ns, FREE_SCAN))  # type: ignore[arg-type]
    assert (monitor.step(10 * S, AHEAD), monitor.reason) == (Twist(), monitor_module.SCAN_STALE)


COUNT = 36


@pytest.mark.parametrize(
    ("range_m", "free_m", "is_end", "is_gap"),
    [
        (math.inf, 6.0, False, False),
        (math.inf, 1.5, True, False),
        (math.inf, 0.0, False, False),  # the scan holds no free floor
        (math.nan, 0.7, True, False),
        (2.0, 1.95, False, False),
        (2.0, 1.0, True, True),
    ],
)
def test_nothing_is_known_between_seen_floor_and_a_surface(
    range_m: float, free_m: float, is_end: bool, is_gap: bool
) -> None:
    ranges, free = [math.inf] * COUNT, [6.0] * COUNT
    for k in range(10, 10 + UNKNOWN_SECTORS):
        ranges[k], free[k] = range_m, free_m
    found = unknown_ends(ranges, free, 0.15)
    assert [end.sector for end in found] == (list(range(10, 10 + UNKNOWN_SECTORS)) if is_end else [])
    assert all(end.free_m == free_m and end.is_gap == is_gap for end in found)
    ranges[10], free[10] = math.inf, 6.0
    assert not unknown_ends(ranges, free, 0.15), "too narrow to be more than noise"


def test_a_scan_without_free_floor_is_unknown_where_it_shows_no_range() -> None:
    ranges = [2.0] * COUNT
    ranges[: UNKNOWN_SECTORS + 1] = [math.nan] * (UNKNOWN_SECTORS + 1)
    assert [end.free_m for end in unknown_ends(ranges, (), 0.15)] == [0.0] * (UNKNOWN_SECTORS + 1)
