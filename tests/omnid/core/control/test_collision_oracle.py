"""The collision monitor against an outline swept in millimetres, with random scans, motions, settings and brakes.

The sweep errs by its steps, so the monitor must lie between the results of an outline that is a little larger and of
one that is a little smaller.
"""

from __future__ import annotations

import cmath
import itertools
import math
import random
from collections.abc import Sequence

import numpy as np
import pytest

from omnid.core.control.collision_monitor import (
    MOVING,
    CollisionMonitor,
    CollisionSettings,
    ControllerScan,
    MovingPoint,
)
from omnid.core.control.heading_controller import Twist
from tests.omnid.core.control import swept_outline
from tests.omnid.core.control.swept_outline import Box

S = 10**9
SLACK_M = 2e-3
SECTORS = 72
LEAST_MPS, BRAKING_SHARE = 0.02, 0.8  # as documented in the monitor
Pair = tuple[float, float]


def azimuth_rad(sector: int, count: int = SECTORS) -> float:
    """Return the direction of the middle of a sector; the first begins behind."""
    return math.radians(-180.0 + 360.0 * (sector + 0.5) / count)


def any_settings(rng: random.Random, **changes: object) -> CollisionSettings:
    numbers = {
        "front_m": rng.uniform(0.1, 0.5),
        "rear_m": rng.uniform(0.1, 0.5),
        "half_width_m": rng.uniform(0.1, 0.35),
        "stop_m": rng.uniform(0.05, 0.2),
        "side_m": rng.uniform(0.02, 0.1),
        "time_s": rng.uniform(0.4, 2.5),
        "slow_m": 0.0,
        "slow_side_m": 0.0,
        "slow_mps": 9.0,
        "stale_s": 10.0,
        "unknown": "ignore",
    }
    return CollisionSettings(**{**numbers, **changes})  # type: ignore[arg-type]


def any_motion(rng: random.Random) -> Pair:
    """Return a motion forward or backward, slow or fast, straight, on an arc or on the spot."""
    v = rng.choice((0.0, 0.005, rng.uniform(0.1, 0.8), -rng.uniform(0.1, 0.8), -rng.uniform(0.1, 0.8)))
    turn = rng.choice((-1, 1)) * rng.uniform(0.3, 2.5)
    return v, turn if v == 0.0 else rng.choice((0.0, turn))


def outline_of(settings: CollisionSettings) -> Box:
    return settings.front_m, settings.rear_m, settings.half_width_m


def stop_box(settings: CollisionSettings, v: float) -> Box:
    """Return the outline with the distance to keep ahead, on the side of the motion, and at the sides."""
    front_m, rear_m, half_width_m = outline_of(settings)
    return (
        front_m + settings.stop_m * (v > 0.0),
        rear_m + settings.stop_m * (v < 0.0),
        half_width_m + settings.side_m,
    )


def driven(monitor: CollisionMonitor, rng: random.Random, scan_ns: int, now_ns: int) -> tuple[complex, float]:
    """Drive any way since the images of the scan; return position and yaw."""
    place, yaw, forward = 0j, 0.0, rng.uniform(-1.0, 1.0)
    for at_ns in range(scan_ns, now_ns, S // 10):
        v, w = forward + rng.uniform(-0.2, 0.2), rng.uniform(-1.0, 1.0)
        monitor.follow(at_ns, Twist(v, w))
        place, yaw = travelled((v, w), 0.1, place, yaw)
    return place, yaw


def travelled(motion: Pair, time_s: float, place: complex, yaw: float) -> tuple[complex, float]:
    """Return position and yaw after a time, by steps of a millisecond."""
    v, w = motion
    for _ in range(round(1000 * time_s)):
        place += v * 1e-3 * cmath.exp(1j * (yaw + w * 5e-4))
        yaw += w * 1e-3
    return place, yaw


def add_ahead(
    ranges: list[float], motion: Pair, settings: CollisionSettings, rng: random.Random, now: tuple[complex, float]
) -> None:
    """Put an obstacle where the front or the rear of the base will be within the time that it keeps, or soon after."""
    place, yaw = travelled(motion, rng.uniform(0.0, 1.3 * settings.time_s), *now)
    end_m = settings.stop_m + settings.front_m if motion[0] >= 0 else -settings.stop_m - settings.rear_m
    point = place + complex(end_m, rng.uniform(-0.9, 0.9) * settings.half_width_m) * cmath.exp(1j * yaw)
    if abs(point) > 0.1:
        ranges[math.floor((cmath.phase(point) / math.tau + 0.5) * SECTORS) % SECTORS] = abs(point)


def share_before(
    settings: CollisionSettings, braking_mps2: float, motion: Pair, points: Sequence[complex], grow_m: float
) -> float:
    """Return the share of a motion that keeps time and braking distance before points that stand."""
    v, _ = motion
    box = stop_box(settings, v)
    within = swept_outline.depth_m(box, np.array(points)) <= 0.0
    for point in np.array(points)[within]:
        if swept_outline.approach_mps(outline_of(settings), motion, point) > 1e-4:
            return 0.0
    outside = np.array(points)[~within]
    if not len(outside):
        return 1.0
    # From twice the time on nothing slows the base down but weak brakes.
    longest_s = max(2.0 * settings.time_s, 1.5 * abs(v) / braking_mps2)
    first_s = swept_outline.contact_s(swept_outline.grown(box, grow_m), motion, list(outside), longest_s)
    if math.isinf(first_s):
        return 1.0
    share = first_s / settings.time_s
    if v != 0.0:
        share = min(share, math.sqrt(2 * BRAKING_SHARE * braking_mps2 * abs(v) * first_s) / abs(v))
        share *= share * abs(v) >= LEAST_MPS or share >= 1.0
    return min(1.0, share)


def is_clear(settings: CollisionSettings, motion: Pair, points: Sequence[complex]) -> bool:
    """True if no point is so near to an edge, nor so nearly passed along one, that the sweep's errors would decide."""
    if not points:
        return True
    box = stop_box(settings, motion[0])
    inside = [point for point in points if swept_outline.depth_m(box, point) <= 0.0]
    return bool(
        (np.abs(swept_outline.depth_m(box, np.array(points))) > 3 * SLACK_M).all()
        and all(abs(swept_outline.approach_mps(outline_of(settings), motion, point)) > 1e-3 for point in inside)
    )


def seen_from(place: complex, yaw: float, points: Sequence[complex]) -> list[complex]:
    return [(point - place) * cmath.exp(-1j * yaw) for point in points]


def check(
    settings: CollisionSettings,
    braking_mps2: float,
    motion: Pair,
    points: Sequence[complex],
    found: float,
    least: float = 0.0,
) -> float:
    """Compare the share that was found with that of the sweep; return the latter."""
    low, high = (max(least, share_before(settings, braking_mps2, motion, points, by_m)) for by_m in (SLACK_M, -SLACK_M))
    assert low - 0.01 <= found <= high + 0.01, (settings, braking_mps2, motion, points, low, found, high)
    return (low + high) / 2


def drove_over(
    settings: CollisionSettings, motion: Pair, before: Sequence[complex], now: Sequence[complex], way_m: float
) -> bool:
    """True if a point that was ahead of the leading edge is now behind that, between the sides, by the way at most."""
    side = math.copysign(1.0, motion[0])
    edge_m = settings.front_m if side > 0 else settings.rear_m
    return motion[0] != 0.0 and any(
        side * then.real >= edge_m
        and 0 < edge_m - side * point.real <= way_m
        and abs(point.imag) < settings.half_width_m
        for then, point in zip(before, now, strict=True)
    )


def test_the_share_is_that_of_a_sweep_after_any_way_since_the_images() -> None:
    rng, shares, over = random.Random(1), list[float](), 0
    for _ in range(220):
        settings, braking_mps2, motion = any_settings(rng), rng.uniform(0.05, 2.0), any_motion(rng)
        monitor = CollisionMonitor(settings, braking_mps2)
        scan_ns, now_ns = 50 * S, 50 * S + rng.randrange(0, 2 * S, S // 10)
        place, yaw = driven(monitor, rng, scan_ns, now_ns)
        ranges = [math.inf] * SECTORS
        for sector in rng.sample(range(SECTORS), rng.randrange(0, 7)):
            ranges[sector] = rng.uniform(0.2, 3.0)
        if rng.random() < 0.7:
            add_ahead(ranges, motion, settings, rng, (place, yaw))
        points = seen_from(place, yaw, [cmath.rect(r, azimuth_rad(k)) for k, r in enumerate(ranges) if r < math.inf])
        if not points or not is_clear(settings, motion, points):
            continue
        monitor.set_scan(ControllerScan(scan_ns, tuple(ranges)))
        allowed = monitor.step(now_ns, Twist(*motion))
        found = (allowed.velocity_mps + allowed.yaw_rate_radps) / sum(motion)
        assert bool(monitor.reason) == (found < 1.0) and monitor.share == pytest.approx(found)
        before = [cmath.rect(r, azimuth_rad(k)) for k, r in enumerate(ranges) if r < math.inf]
        if drove_over(settings, motion, before, points, abs(place)):
            over += 1
            assert found == 0.0
            continue
        shares.append(check(settings, braking_mps2, motion, points, found))
    assert over > 3
    reduced = [share for share in shares if 0.0 < share < 1.0]
    assert len(reduced) > 15 and shares.count(0.0) > 15 and shares.count(1.0) > 15


def any_unknown(rng: random.Random) -> tuple[tuple[bool, ...], list[int]]:
    """Return which sectors are unknown, and those of them in runs of five and more, also across the seam behind."""
    unknown = [False] * SECTORS
    for _ in range(rng.randrange(1, 5)):
        begin = rng.randrange(SECTORS)
        for k in range(begin, begin + rng.randrange(2, 9)):
            unknown[k % SECTORS] = True
    known = [k for k in range(-SECTORS, 2 * SECTORS) if not unknown[k % SECTORS]]
    runs = [range(low + 1, high) for low, high in itertools.pairwise(known) if high - low > 5]
    return tuple(unknown), sorted({k % SECTORS for run in runs for k in run})


def edge_m(box: Box, ray: complex) -> float:
    """Return where a ray from the origin leaves a rectangle, by steps."""
    return float(np.argmax(swept_outline.depth_m(box, np.arange(0.0, 1.0, 1e-4) * ray) >= 0.0)) * 1e-4


@pytest.mark.parametrize("policy", ["stop", "slow"])
def test_the_end_of_what_was_seen_counts_as_a_wall(policy: str) -> None:
    rng, shares, turns = random.Random(2), list[float](), list[float]()
    for _ in range(150):
        settings = any_settings(rng, slow_mps=rng.uniform(0.05, 0.3), stale="ignore", unknown=policy)
        braking_mps2, motion = rng.uniform(0.05, 2.0), any_motion(rng)
        unknown, counted = any_unknown(rng)
        free_m = tuple(rng.uniform(0.0, 1.5) for _ in range(SECTORS))
        rays = {k: cmath.rect(1.0, azimuth_rad(k)) for k in counted}
        walls = [max(free_m[k], edge_m(outline_of(settings), ray)) * ray for k, ray in rays.items()]
        if not is_clear(settings, motion, walls):
            continue
        monitor = CollisionMonitor(settings, braking_mps2)
        # What is not unknown is open up to the longest range.
        free_m = tuple(f if one else 6.0 for f, one in zip(free_m, unknown, strict=True))
        monitor.set_scan(ControllerScan(S, tuple(math.nan if one else math.inf for one in unknown), free_m))
        allowed = monitor.step(S, Twist(*motion))
        found = (allowed.velocity_mps + allowed.yaw_rate_radps) / sum(motion)
        edge_mps = abs(motion[0])
        if motion[0] == 0.0:
            # What may be at the outline already keeps no base from turning on the spot.
            walls = [wall for wall in walls if swept_outline.depth_m(stop_box(settings, 0.0), wall) > 0.0]
            edge_mps = abs(motion[1]) * math.hypot(max(settings.front_m, settings.rear_m), settings.half_width_m)
            turns.append(found)
        if not walls:
            assert found == 1.0
            continue
        least = min(1.0, settings.slow_mps / edge_mps) if policy == "slow" else 0.0
        shares.append(check(settings, braking_mps2, motion, walls, found, least))
    assert sum(share < 1.0 for share in shares) > 8 and sum(share == 1.0 for share in shares) > 8
    assert sum(turn < 1.0 for turn in turns) > 3 and turns.count(1.0) > 3


@pytest.mark.parametrize("policy", ["stop", "slow"])
def test_where_the_images_show_nothing_the_way_ends_at_the_distance_to_keep(policy: str) -> None:
    """A straight motion: nothing is left before the front or the rear, and there is room at the sides."""
    rng, counts = random.Random(6), {True: 0, False: 0}
    for _ in range(200):
        settings = any_settings(rng, slow_mps=rng.uniform(0.05, 0.3), stale=policy)
        v = rng.choice((-1, 1)) * rng.uniform(0.1, 0.8)
        unknown, counted = any_unknown(rng)
        width_m = settings.half_width_m + settings.side_m
        ahead_m = settings.stop_m + (settings.front_m if v > 0 else settings.rear_m)
        # Sideways distance at which the rays to the front, or the rear, cross the line at the distance to keep.
        across_m = [ahead_m * abs(math.tan(azimuth_rad(k))) for k in counted if math.cos(azimuth_rad(k)) * v > 0]
        if any(abs(y_m - width_m) < 0.01 for y_m in across_m):
            continue
        ends = any(y_m < width_m for y_m in across_m)
        monitor = CollisionMonitor(settings, 5.0)
        monitor.set_scan(ControllerScan(S, tuple(math.nan if one else math.inf for one in unknown), (), (), unknown))
        least = min(1.0, settings.slow_mps / abs(v)) if policy == "slow" else 0.0
        assert monitor.step(S, Twist(v)).velocity_mps == pytest.approx((least if ends else 1.0) * v, abs=1e-6)
        counts[ends] += 1
    assert min(counts.values()) > 20


def test_beside_parts_where_the_images_show_nothing_there_is_room_of_a_hand() -> None:
    """Dead parts at both sides: arcs end where the sides, or swinging corners, reach 0.05 m beyond what they keep."""
    rng, shares = random.Random(7), []
    ranges = [math.nan if abs(abs(azimuth_rad(k)) - math.pi / 2) < 0.22 else math.inf for k in range(SECTORS)]
    dead = tuple(map(math.isnan, ranges))
    for _ in range(60):
        settings, braking_mps2 = any_settings(rng, stale="stop"), rng.uniform(0.2, 2.0)
        motion = (rng.choice((-1, 1)) * rng.uniform(0.1, 0.6), rng.choice((-1, 1)) * rng.uniform(0.5, 2.0))
        side_m = settings.half_width_m + settings.side_m + 0.05
        rays = [cmath.rect(1.0, azimuth_rad(k)) for k in range(SECTORS) if dead[k]]
        walls = [ray * side_m / abs(ray.imag) for ray in rays]
        monitor = CollisionMonitor(settings, braking_mps2)
        monitor.set_scan(ControllerScan(S, tuple(ranges), (), (), dead))
        found = monitor.step(S, Twist(*motion)).velocity_mps / motion[0]
        shares.append(check(settings, braking_mps2, motion, walls, found))
    assert sum(share < 1.0 for share in shares) > 10 and sum(share == 1.0 for share in shares) > 10


def test_a_base_is_slow_while_something_is_in_the_slow_polygon() -> None:
    rng, slow = random.Random(3), 0
    for _ in range(400):
        settings = any_settings(
            rng,
            slow_m=rng.uniform(0.1, 1.0),
            slow_side_m=rng.uniform(0.0, 0.5),
            slow_mps=0.2,
            time_s=0.2,
            stop_m=0.01,
            side_m=0.0,
        )
        v, w = motion = any_motion(rng)
        sector, range_m = rng.randrange(SECTORS), rng.uniform(0.6, 1.6)
        point = cmath.rect(range_m, azimuth_rad(sector))
        if share_before(settings, 5.0, motion, [point], 0.05) < 1.0:
            continue
        monitor = CollisionMonitor(settings, 5.0)
        monitor.set_scan(ControllerScan(S, tuple(range_m if k == sector else math.inf for k in range(SECTORS))))
        ahead_m = point.real if v > 0 else -point.real
        far_m = settings.slow_m + (settings.front_m if v > 0 else settings.rear_m)
        is_near = (
            abs(v) > 0.2 and 0.0 <= ahead_m <= far_m and abs(point.imag) <= settings.half_width_m + settings.slow_side_m
        )
        corner_m = math.hypot(max(settings.front_m, settings.rear_m), settings.half_width_m)
        share = min(1.0, 0.2 / max(abs(v), abs(w) * corner_m)) if is_near else 1.0
        allowed = monitor.step(S, Twist(v, w))
        assert (allowed.velocity_mps, allowed.yaw_rate_radps) == pytest.approx((share * v, share * w))
        slow += is_near
    assert slow > 15


@pytest.mark.parametrize("has_scan", [True, False])
def test_without_a_fresh_scan_no_corner_is_faster_than_the_slow_speed(has_scan: bool) -> None:
    rng = random.Random(4)
    for _ in range(100):
        settings, (v, w) = any_settings(rng, stale="slow", stale_s=0.5, slow_mps=0.15), any_motion(rng)
        monitor = CollisionMonitor(settings, 1.0)
        if has_scan:
            monitor.set_scan(ControllerScan(S, (math.inf,) * SECTORS))
        allowed = monitor.step(3 * S, Twist(v, w))
        corner_m = math.hypot(max(settings.front_m, settings.rear_m), settings.half_width_m)
        share = min(1.0, 0.15 / max(abs(v), abs(w) * corner_m))
        assert (allowed.velocity_mps, allowed.yaw_rate_radps) == pytest.approx((share * v, share * w))


def test_moving_obstacles_are_where_they_will_be() -> None:
    """Their circles against the outline, every 0.1 s on the arc; what is nearer in time than 0.5 s stops the base.

    And the base is at rest before one that comes nearer could reach it at 1.6 m/s.
    """
    rng, shares = random.Random(5), []
    for _ in range(300):
        settings, (v, w) = any_settings(rng), any_motion(rng)
        monitor = CollisionMonitor(settings, 5.0)
        scan_ns, age_s = 50 * S, rng.randrange(0, 10) / 10
        place, yaw = driven(monitor, rng, scan_ns, scan_ns + round(age_s * S))
        obstacle = MovingPoint(
            *(rng.uniform(-2.0, 2.0) for _ in range(2)),
            *(rng.uniform(-1.0, 1.0) for _ in range(2)),
            rng.uniform(0.1, 0.4),
        )
        times, paths = swept_outline.sweep((v, w), [0j, 1 + 0j], 2.0 + 1e-6, 1e-3)
        expected, margin_m = 1.0, math.inf
        for step in range(20):
            at = min(100 * step, len(times) - 1)
            at_s = age_s + 0.1 * step
            [now] = seen_from(
                place, yaw, [complex(obstacle.x_m + obstacle.vx_mps * at_s, obstacle.y_m + obstacle.vy_mps * at_s)]
            )
            # In the axes of the base now, the base then has its origin where a point that stands at 0 is seen from it.
            turned = paths[at, 1] - paths[at, 0]
            then = paths[at, 0] + now * turned
            gap_m = float(swept_outline.depth_m(stop_box(settings, v), then)) - obstacle.radius_m
            nears_mps = swept_outline.approach_mps(outline_of(settings), (v, w), then) if step == 0 else 1.0
            margin_m = min(margin_m, abs(gap_m), abs(nears_mps))
            if step == 0:
                away_m = max(0.0, float(swept_outline.depth_m(outline_of(settings), now))) - obstacle.radius_m
                limit_mps = BRAKING_SHARE * 5.0 * (away_m / 1.6 - 0.4)
                velocity = complex(obstacle.vx_mps, obstacle.vy_mps)
                [later] = seen_from(place, yaw, [complex(obstacle.x_m, obstacle.y_m) + (at_s + 0.1) * velocity])
                comes = v != 0.0 and now.real * math.copysign(1.0, v) > -settings.rear_m and abs(later) <= abs(now)
                edge_mps = max(
                    abs(v), abs(w) * math.hypot(max(settings.front_m, settings.rear_m), settings.half_width_m)
                )
                passive = max(0.0, limit_mps) / edge_mps if comes and abs(v) > limit_mps else 1.0
            if gap_m <= 0.0 and nears_mps > 0.0:
                expected = 0.0 if step <= 5 else 0.1 * step / 2.0
                break
        if margin_m < 5e-3:
            continue
        expected = min(expected, passive)
        monitor.set_scan(ControllerScan(scan_ns, (math.inf,) * SECTORS, (), (obstacle,)))
        allowed = monitor.step(scan_ns + round(age_s * S), Twist(v, w))
        assert (allowed.velocity_mps, allowed.yaw_rate_radps) == pytest.approx((expected * v, expected * w))
        assert monitor.reason == (MOVING if expected < 1.0 else "")
        shares.append(expected)
    assert shares.count(0.0) > 20 and shares.count(1.0) > 20 and any(0.0 < share < 1.0 for share in shares)
