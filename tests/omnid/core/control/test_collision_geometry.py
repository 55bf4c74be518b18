"""Time until a moving rectangle touches a point, its edges and approach, against a sweep in millimetres."""

from __future__ import annotations

import math
import random

from omnid.core.control.collision_geometry import MOST_MOTIONS, DrivenMotions, Outline, contact_s
from omnid.core.control.heading_controller import Twist
from tests.omnid.core.control import swept_outline

OUTLINE = Outline(0.3, 0.2, 0.25)
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


def test_a_motion_that_is_forgotten_is_not_reached() -> None:
    motions = DrivenMotions()
    for tick in range(MOST_MOTIONS):
        assert motions.reach_back_to(5)
        motions.add(10 + tick, Twist(1.0))
    assert motions.reach_back_to(10)
    motions.add(10 + MOST_MOTIONS, Twist(1.0))
    assert not motions.reach_back_to(10) and motions.reach_back_to(11)
