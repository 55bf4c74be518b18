"""The collision monitor: polygons, time to collision, unknown directions, old scans, moving obstacles."""

from __future__ import annotations

import cmath
import math
import random
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from omnid.core.control import collision_monitor as monitor_module
from omnid.core.control.collision_monitor import CollisionMonitor, CollisionSettings, ControllerScan, MovingPoint
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
    unobserved: tuple[bool, ...] = (),
) -> tuple[Twist, str]:
    """Return the allowed motion and the reason, before a new scan."""
    monitor = CollisionMonitor(settings, 1.5)
    monitor.set_scan(ControllerScan(10 * S, ranges, free, moving, unobserved))
    allowed = monitor.step(10 * S + round(age_s * S), motion)
    return allowed, monitor.reason


@pytest.mark.hazard("H16")
@pytest.mark.parametrize("point", [(0.39, 0.0), (0.3, 0.2), (0.26, -0.1), (0.2, 0.0)])
def test_the_base_stops_before_an_obstacle_in_the_stop_polygon_and_may_back_out(point: tuple[float, float]) -> None:
    assert after(with_points(point)) == (Twist(), monitor_module.BLOCKED)
    allowed, _ = after(with_points(point), Twist(-0.3))
    assert allowed == Twist(-0.3)
    assert after(with_points((-point[0], point[1])), Twist(-0.3)) == (Twist(), monitor_module.BLOCKED)


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


@pytest.mark.hazard("H16")
def test_the_base_drives_slowly_past_an_obstacle_beside_the_way() -> None:
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


def test_a_base_that_may_not_drive_may_turn_to_a_heading() -> None:
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
def test_an_unknown_place_at_the_side_with_a_wall_seen_behind_it_does_not_keep_a_base_from_turning() -> None:
    """A person in that place would hide the wall."""
    free = tuple(0.0 if -150 < k - 179.5 < -100 else 3.0 for k in range(360))
    swings = Twist(0.3, 0.6)
    assert after((3.0,) * 360, swings, free=free) == (swings, "")
    assert after(with_unknown(-150, -100), swings, free=free) == (Twist(), monitor_module.UNKNOWN)


@pytest.mark.hazard("H19")
@pytest.mark.parametrize(("yaw_rate_radps", "goes_on"), [(0.0, True), (0.05, True), (-0.05, True), (0.2, False)])
def test_a_base_drives_along_what_is_unknown_beside_it(yaw_rate_radps: float, goes_on: bool) -> None:
    """A corrected heading takes a corner nearer by a little; a turn into it is refused, and an obstacle counts."""
    motion = Twist(0.5, yaw_rate_radps)
    for way in (1, -1):
        beside, turned = with_unknown(45, 135), Twist(way * 0.5, motion.yaw_rate_radps)
        assert (after(beside, turned) == (turned, "")) == goes_on
    near, slow = with_points((0.1, 0.24), (-0.1, 0.24)), Twist(0.15, 0.3 * yaw_rate_radps)
    assert (after(near, slow) == (slow, "")) == (yaw_rate_radps == 0.0)


@pytest.mark.hazard("H22")
@pytest.mark.parametrize("unknown", ["stop", "slow"])
def test_the_base_stops_before_dead_and_blind_parts_of_the_images(unknown: str) -> None:
    """Whatever the setting for the end of the seen floor is: something may have come there."""
    ranges, settings = with_unknown(-30, 30), replace(SETTINGS, unknown=unknown)
    unobserved = tuple(math.isnan(range_m) for range_m in ranges)
    assert after(ranges, settings=settings, unobserved=unobserved) == (Twist(), monitor_module.UNOBSERVED)
    for away in (Twist(-0.5), Twist(0.0, 1.0)):
        assert after(ranges, away, settings, unobserved=unobserved) == (away, "")


@pytest.mark.hazard("H23")
def test_in_the_dark_the_base_does_not_even_turn() -> None:
    """Directions that are unknown because they are plain do not keep a base from turning away; no image at all does."""
    ranges, turn = (math.nan,) * 360, Twist(0.0, 1.0)
    assert after(ranges, turn) == (turn, "")
    assert after(ranges, turn, unobserved=(True,) * 360) == (Twist(), monitor_module.UNSEEN)


@pytest.mark.hazard("H21")
def test_a_stale_scan_and_a_missing_one_stop_the_base() -> None:
    assert after(FREE_SCAN, age_s=SETTINGS.stale_s + 0.01) == (Twist(), monitor_module.SCAN_STALE)
    missing = CollisionMonitor(SETTINGS, 1.5)
    assert (missing.step(S, Twist()), missing.reason) == (Twist(), "")
    assert (missing.step(S, AHEAD), missing.reason) == (Twist(), monitor_module.SCAN_STALE)


@pytest.mark.hazard("H20")
@pytest.mark.parametrize("age_s", [0.1, 0.2, 0.3, 0.4, 0.5])
@pytest.mark.parametrize("speed_mps", [0.6, -0.6, 1.5])
def test_an_older_scan_makes_the_base_no_freer(age_s: float, speed_mps: float) -> None:
    """The end of the floor that was in front of the base is inside its outline by now, or behind it."""
    nothing_ahead = tuple(0.0 if abs(abs(k - 179.5) - 180 * (speed_mps < 0)) < 60 else 6.0 for k in range(360))
    ranges = tuple(math.nan if free == 0.0 else math.inf for free in nothing_ahead)
    for unobserved in ((), tuple(free == 0.0 for free in nothing_ahead)):
        monitor = CollisionMonitor(SETTINGS, 1.5)
        monitor.set_scan(ControllerScan(10 * S, ranges, nothing_ahead, unobserved=unobserved))
        for tick in range(round(20 * age_s)):
            monitor.follow(10 * S + tick * S // 20, Twist(speed_mps))
        now_ns = 10 * S + round(age_s * S)
        assert monitor.step(now_ns, Twist(speed_mps)) == Twist()
        if age_s * abs(speed_mps) < SETTINGS.front_m:
            assert monitor.step(now_ns, Twist(-speed_mps)) == Twist(-speed_mps), "it may back out"


@pytest.mark.hazard("H17")
def test_a_person_who_comes_from_the_side_stops_the_base_and_one_who_leaves_does_not() -> None:
    crossing = MovingPoint(0.9, 0.9, 0.0, -1.0, 0.25)
    allowed, reason = after(FREE_SCAN, moving=(crossing,))
    assert allowed.velocity_mps < 0.35 and reason == monitor_module.MOVING
    assert after(FREE_SCAN, moving=(crossing._replace(y_m=1.8, vy_mps=1.0),)) == (AHEAD, "")
    near = MovingPoint(0.9, 0.0, -1.0, 0.0, 0.25)
    assert after(FREE_SCAN, moving=(near,)) == (Twist(), monitor_module.MOVING)


@pytest.mark.hazard("H17")
def test_the_base_is_at_rest_before_a_person_beside_its_way_who_turns_towards_it_reaches_it() -> None:
    """At 1.6 m/s, 0.4 s after the turn; one who leaves lets it drive on slowly."""
    beside = MovingPoint(0.5, 1.3, 0.0, -0.05, 0.25)
    gap_m = math.hypot(0.5 - SETTINGS.front_m, 1.295 - SETTINGS.half_width_m) - 0.25
    allowed, reason = after(FREE_SCAN, moving=(beside,))
    assert allowed.velocity_mps == pytest.approx(0.8 * 1.5 * (gap_m / 1.6 - 0.4)) and reason == monitor_module.MOVING
    leaving = beside._replace(y_m=1.0, vy_mps=0.05)
    assert after(FREE_SCAN, moving=(leaving,))[0].velocity_mps == pytest.approx(SETTINGS.slow_mps)
    assert after(FREE_SCAN, Twist(-0.5), moving=(leaving._replace(x_m=0.8),)) == (Twist(-0.5), "")


@pytest.mark.hazard("H17")
def test_a_new_moving_obstacle_slows_the_base_down_where_it_may_go() -> None:
    """Seen twice, it seems to walk next to the way; a third observation makes the sigma smaller than 0.4 m/s."""
    new = MovingPoint(1.0, 1.6, 0.0, -0.1, 0.2, 0.1, 0.6)
    allowed, reason = after(FREE_SCAN, moving=(new,))
    assert allowed.velocity_mps == pytest.approx(0.4) and reason == monitor_module.MOVING
    assert after(FREE_SCAN, moving=(new._replace(sigma_mps=0.3),)) == (AHEAD, "")
    assert after(FREE_SCAN, moving=(new._replace(y_m=3.0),)) == (AHEAD, "")


def test_the_monitor_never_allows_more_than_was_asked_nor_another_direction() -> None:
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


# A second account: the outline swept along its arc in millimetres. It shares no code with omnid.
Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Box = tuple[float, float, float]  # to the front, to the rear, to either side
Pair = tuple[float, float]  # speed and yaw rate
SLACK_M = 2e-3
SECTORS = 72
LEAST_MPS, BRAKING_SHARE = 0.02, 0.8  # as documented in the monitor


def depth_m(box: Box, points: Complex) -> Array:
    """Return the distance of points from the outline, below 0 inside."""
    front_m, rear_m, half_width_m = box
    dx = np.maximum(points.real - front_m, -rear_m - points.real)
    dy = np.abs(points.imag) - half_width_m
    outside = np.hypot(np.maximum(dx, 0.0), np.maximum(dy, 0.0))
    return np.where(outside > 0.0, outside, np.maximum(dx, dy))


def seen_after(motion: Pair, points: Complex, times: Array) -> Complex:
    """Return points at rest in the axes of the base after times [s] of a motion, (times, points)."""
    v, w = motion
    places = v * times * np.sinc(w * times / math.tau) * np.exp(0.5j * w * times)
    return np.asarray((points[None, :] - places[:, None]) * np.exp(-1j * w * times)[:, None])


def contact_s(box: Box, motion: Pair, points: Complex, longest_s: float) -> float:
    """Return when the outline first contains a point; inf if it does not within the time."""
    v, w = motion
    fastest_mps = abs(v) + abs(w) * (np.abs(points).max() + abs(v) * longest_s)
    times = np.arange(0.0, longest_s, max(1e-3 / fastest_mps, longest_s / 100_000))
    hits = np.flatnonzero((depth_m(box, seen_after(motion, points, times)) <= 0.0).any(axis=1))
    return float(times[hits[0]]) if len(hits) else math.inf


def approach_mps(box: Box, motion: Pair, points: Complex) -> Array:
    """Return the speeds with which the outline nears points, or takes them deeper inside; below 0 where it leaves."""
    before, after = depth_m(box, seen_after(motion, points, np.array([0.0, 1e-6])))
    return (before - after) / 1e-6


def any_settings(rng: random.Random) -> CollisionSettings:
    return CollisionSettings(
        front_m=rng.uniform(0.1, 0.5),
        rear_m=rng.uniform(0.1, 0.5),
        half_width_m=rng.uniform(0.1, 0.35),
        stop_m=rng.uniform(0.05, 0.2),
        side_m=rng.uniform(0.02, 0.1),
        time_s=rng.uniform(0.4, 2.5),
        slow_m=0.0,
        slow_side_m=0.0,
        slow_mps=9.0,
        stale_s=10.0,
    )


def any_motion(rng: random.Random) -> Pair:
    """Return a motion forward or backward, slow or fast, straight, on an arc or on the spot."""
    v = rng.choice((0.0, 0.005, rng.uniform(0.1, 0.8), -rng.uniform(0.1, 0.8), -rng.uniform(0.1, 0.8)))
    turn = rng.choice((-1, 1)) * rng.uniform(0.3, 2.5)
    return v, turn if v == 0.0 else rng.choice((0.0, turn))


def outlines(settings: CollisionSettings, v: float) -> tuple[Box, Box]:
    """Return the outline, and that with the distance to keep ahead, on the side of the motion, and at the sides."""
    front_m, rear_m, half_width_m = settings.front_m, settings.rear_m, settings.half_width_m
    ahead_m, behind_m = settings.stop_m * (v > 0.0), settings.stop_m * (v < 0.0)
    return (front_m, rear_m, half_width_m), (front_m + ahead_m, rear_m + behind_m, half_width_m + settings.side_m)


def share_before(
    settings: CollisionSettings, braking_mps2: float, motion: Pair, points: Complex, grow_m: float
) -> float:
    """Return the share of a motion that keeps time and braking distance before points at rest."""
    speed_mps = abs(motion[0])
    outline, box = outlines(settings, motion[0])
    within = depth_m(box, points) <= 0.0
    if (approach_mps(outline, motion, points[within]) > 1e-4).any():
        return 0.0
    if within.all():
        return 1.0
    # From twice the time on nothing slows the base down but weak brakes.
    longest_s = max(2.0 * settings.time_s, 1.5 * speed_mps / braking_mps2)
    grown = box[0] + grow_m, box[1] + grow_m, box[2] + grow_m
    first_s = contact_s(grown, motion, points[~within], longest_s)
    if math.isinf(first_s):
        return 1.0
    share = first_s / settings.time_s
    if speed_mps > 0.0:
        share = min(share, math.sqrt(2 * BRAKING_SHARE * braking_mps2 * speed_mps * first_s) / speed_mps)
        share *= share * speed_mps >= LEAST_MPS or share >= 1.0
    return min(1.0, share)


def test_the_share_is_that_of_a_sweep_after_a_way_since_the_images() -> None:
    rng, shares = random.Random(1), list[float]()
    for _ in range(400):
        settings, braking_mps2, motion = any_settings(rng), rng.uniform(0.05, 2.0), any_motion(rng)
        ranges = [math.inf] * SECTORS
        for sector in rng.sample(range(SECTORS), rng.randrange(1, 7)):
            ranges[sector] = rng.uniform(0.2, 1.5)
        azimuths = np.radians(-180.0 + 360.0 * (np.arange(SECTORS) + 0.5) / SECTORS)
        there = np.array([cmath.rect(r, a) for r, a in zip(ranges, azimuths.tolist(), strict=True) if r < math.inf])
        before, way_s = any_motion(rng), 0.1 * rng.randrange(4)
        points = seen_after(before, there, np.array([way_s]))[0]
        outline, box = outlines(settings, motion[0])
        inside = points[depth_m(box, points) <= 0.0]
        # So near to an edge, or passed so nearly along one, that errors of the sweep decide; or driven over.
        if (np.abs(depth_m(box, points)) < 3 * SLACK_M).any() or (depth_m(outline, points) < 0.0).any():
            continue
        if (np.abs(approach_mps(outline, motion, inside)) < 1e-3).any():
            continue
        monitor = CollisionMonitor(settings, braking_mps2)
        for tick in range(round(10 * way_s)):
            monitor.follow(50 * S + tick * S // 10, Twist(*before))
        monitor.set_scan(ControllerScan(50 * S, tuple(ranges)))
        allowed = monitor.step(50 * S + round(way_s * S), Twist(*motion))
        found = (allowed.velocity_mps + allowed.yaw_rate_radps) / sum(motion)
        assert bool(monitor.reason) == (found < 1.0) and monitor.share == pytest.approx(found)
        low, high = (share_before(settings, braking_mps2, motion, points, by_m) for by_m in (SLACK_M, -SLACK_M))
        assert low - 0.01 <= found <= high + 0.01, (settings, braking_mps2, motion, points, low, found, high)
        shares.append((low + high) / 2)
    reduced = [share for share in shares if 0.0 < share < 1.0]
    assert len(reduced) > 15 and shares.count(0.0) > 15 and shares.count(1.0) > 15
