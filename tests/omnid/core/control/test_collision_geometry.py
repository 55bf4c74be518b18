"""Time until a moving rectangle touches a point, its edges and approach, against a sweep in millimetres."""

from __future__ import annotations

import math
import random

import pytest

from omnid.core.control.collision_geometry import MOST_MOTIONS, DrivenMotions, Outline, contact_s
from omnid.core.control.heading_controller import Twist
from tests.omnid.core.control import swept_outline

OUTLINE = Outline(0.3, 0.2, 0.25)
S = 1_000_000_000
SLACK_M = 2e-3  # of the sweep's steps


def any_outline(rng: random.Random) -> Outline:
    return Outline(rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.4))


def any_motion(rng: random.Random) -> Twist:
    """Return a motion forward or backward, straight, on an arc or on the spot."""
    velocity_mps = rng.choice((0.0, rng.uniform(0.1, 0.8), -rng.uniform(0.1, 0.8)))
    turn_radps = rng.choice((-1, 1)) * rng.uniform(0.4, 2.5)
    return Twist(velocity_mps, turn_radps if velocity_mps == 0.0 else rng.choice((0.0, turn_radps)))


def test_the_time_is_that_of_a_sweep() -> None:
    """The outline touches the point then, and not before; where it never does, no step has the point inside."""
    rng = random.Random(4)
    met = missed = 0
    for _ in range(250):
        outline, motion, point = any_outline(rng), any_motion(rng), complex(rng.uniform(-1, 1), rng.uniform(-1, 1))
        pair = (motion.velocity_mps, motion.yaw_rate_radps)
        if swept_outline.depth_m(outline, point) < 0.01:
            continue
        longest_s = math.tau / abs(motion.yaw_rate_radps) if motion.yaw_rate_radps else 5.0
        found = contact_s(outline, motion, [(point.real, point.imag)])
        times, seen = swept_outline.sweep(pair, [point], longest_s)
        depths = swept_outline.depth_m(outline, seen)[:, 0]
        assert depths[times < found].min() > -SLACK_M, (outline, motion, point)
        if found < times[-1]:
            at = int(times.searchsorted(found))
            assert abs(depths[at]) < SLACK_M, (outline, motion, point)
        met, missed = met + (found < times[-1]), missed + math.isinf(found)
    assert met > 25 and missed > 50


@pytest.mark.parametrize(
    ("motion", "point", "expected"),
    [
        (Twist(0.5), (0.8, 0.1), 1.0),
        (Twist(-0.5), (-0.7, 0.1), 1.0),
        (Twist(0.5), (0.8, 0.3), math.inf),
        (Twist(0.5), (-0.8, 0.0), math.inf),
        (Twist(0.0, 1.0), (0.2, 2.0), math.inf),
        (Twist(), (0.4, 0.0), math.inf),
        (Twist(), (-0.4, 0.0), math.inf),
        (Twist(1.0), (1.3, 0.0), 1.0),
    ],
)
def test_the_time_by_hand(motion: Twist, point: tuple[float, float], expected: float) -> None:
    assert contact_s(OUTLINE, motion, [point]) == pytest.approx(expected)


def test_a_motion_approaches_a_point_or_leaves_it() -> None:
    """Outside the distance counts, inside the depth below the nearest edge."""
    rng = random.Random(5)
    counts = {(inside, nearer): 0 for inside in (True, False) for nearer in (True, False)}
    for _ in range(1500):
        outline, motion = any_outline(rng), any_motion(rng)
        point = complex(rng.uniform(-0.7, 0.7), rng.uniform(-0.5, 0.5))
        speed_mps = swept_outline.approach_mps(outline, (motion.velocity_mps, motion.yaw_rate_radps), point)
        if abs(speed_mps) < 1e-4:  # along an edge, up to the errors of the steps
            continue
        nearer = outline.is_approached(point.real, point.imag, motion)
        assert nearer == (speed_mps > 0.0), (outline, motion, point)
        counts[bool(outline.parted([(point.real, point.imag)])[0]), nearer] += 1
    assert min(counts.values()) > 100
    assert not OUTLINE.is_approached(0.0, 0.26, Twist(0.1)), "along an edge is not nearer"


@pytest.mark.parametrize("off_m", [0.0, 1e-17, 1e-16, 1e-12, 1e-9, 1e-6, 1e-3])
def test_what_is_at_the_very_edge_is_approached(off_m: float) -> None:
    """There the way begins of which nothing is known: no error of rounding may make it free."""
    for side in (1, -1):
        for x, motion in ((0.3, Twist(0.1)), (-0.2, Twist(-0.1))):
            assert OUTLINE.is_approached(x + side * off_m, 0.1, motion)
            assert not OUTLINE.is_approached(x + side * off_m, 0.1, Twist(-motion.velocity_mps))


def test_the_edge_the_gap_and_the_farthest_corner_are_those_of_the_rectangle() -> None:
    rng = random.Random(6)
    for azimuth_rad in (0.0, math.pi / 2, -math.pi / 2, math.pi, *(rng.uniform(-math.pi, math.pi) for _ in range(200))):
        outline, ray = any_outline(rng), complex(math.cos(azimuth_rad), math.sin(azimuth_rad))
        edge_m = outline.edge_m(azimuth_rad)
        assert swept_outline.depth_m(outline, edge_m * ray) == pytest.approx(0.0, abs=1e-9)
        assert edge_m <= outline.radius_m + 1e-12
        point = rng.uniform(0.0, 2.0) * ray
        depth_m = float(swept_outline.depth_m(outline, point))
        assert outline.gap_m(point.real, point.imag) == pytest.approx(max(depth_m, 0.0))
        inside, outside = outline.parted([(point.real, point.imag)])
        assert (len(inside), len(outside)) == ((1, 0) if depth_m <= 0.0 else (0, 1))
        corner_m = max(abs(complex(x, outline.half_width_m)) for x in (outline.front_m, outline.rear_m))
        assert outline.radius_m == pytest.approx(corner_m)


def test_a_way_begins_at_the_stamp_and_lasts_until_now() -> None:
    motions = DrivenMotions()
    motions.add(1 * S, Twist(1.0))
    motions.add(3 * S, Twist(0.0, math.pi / 2))
    motions.add(4 * S, Twist(2.0))
    # One second straight on, a quarter of a turn to the left, half a second straight on.
    pose = motions.since(2 * S, 4 * S + S // 2)
    assert pose == pytest.approx((1.0, 1.0, math.pi / 2))


def test_a_motion_that_is_forgotten_is_not_reached() -> None:
    motions = DrivenMotions()
    for tick in range(MOST_MOTIONS):
        assert motions.reach_back_to(5)
        motions.add(10 + tick, Twist(1.0))
    assert motions.reach_back_to(10)
    motions.add(10 + MOST_MOTIONS, Twist(1.0))
    assert not motions.reach_back_to(10) and motions.reach_back_to(11)
