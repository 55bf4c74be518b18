"""Time until a moving rectangle touches a point, against a simulation in small steps."""

from __future__ import annotations

import math
import random

import pytest

from omnid.core.control.collision_geometry import Outline, contact_s
from omnid.core.control.heading_controller import Twist

OUTLINE = Outline(0.3, 0.2, 0.25)


def simulated_s(motion: Twist, x_m: float, y_m: float, longest_s: float, step_s: float = 0.005) -> float:
    """Return the time of the contact by steps."""
    x, y, yaw = 0.0, 0.0, 0.0
    for step in range(int(longest_s / step_s)):
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = x_m - x, y_m - y
        if OUTLINE.contains(c * dx + s * dy, c * dy - s * dx):
            return step * step_s
        middle = yaw + motion.yaw_rate_radps * step_s / 2
        x += motion.velocity_mps * step_s * math.cos(middle)
        y += motion.velocity_mps * step_s * math.sin(middle)
        yaw += motion.yaw_rate_radps * step_s
    return math.inf


def test_the_time_is_that_of_a_simulation() -> None:
    rng = random.Random(4)
    met = 0
    for _ in range(150):
        motion = Twist(rng.uniform(-0.8, 0.8), rng.choice((0.0, rng.uniform(-2, 2))))
        x, y = rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6)
        if OUTLINE.gap_m(x, y) < 0.01:
            continue
        expected, found = simulated_s(motion, x, y, 1.5), contact_s(OUTLINE, motion, x, y)
        met += math.isfinite(expected)
        if math.isfinite(expected):
            assert found <= expected + 1e-6, (motion, x, y)
        # A corner that touches a point only just may be left out by the steps.
        if found < 1.49 and not math.isfinite(expected):
            assert simulated_s(motion, x, y, 1.5, 1e-4) < math.inf, (motion, x, y)
    assert met > 12


@pytest.mark.parametrize(("motion", "point", "expected"), [
    (Twist(0.5), (0.8, 0.1), 1.0), (Twist(-0.5), (-0.7, 0.1), 1.0), (Twist(0.5), (0.8, 0.3), math.inf),
    (Twist(0.5), (-0.8, 0.0), math.inf), (Twist(0.0, 1.0), (0.2, 2.0), math.inf), (Twist(), (0.4, 0.0), math.inf),
])
def test_the_time_by_hand(motion: Twist, point: tuple[float, float], expected: float) -> None:
    assert contact_s(OUTLINE, motion, *point) == pytest.approx(expected)


@pytest.mark.parametrize(("motion", "point", "approached"), [
    (Twist(0.1), (0.35, 0.0), True), (Twist(-0.1), (0.35, 0.0), False), (Twist(0.1), (0.0, 0.26), False),
    (Twist(0.0, 1.0), (0.2, 0.26), True), (Twist(0.0, -1.0), (0.2, 0.26), False),
    (Twist(0.1), (0.29, 0.0), True), (Twist(-0.1), (0.29, 0.0), False), (Twist(-0.1), (-0.19, 0.0), True),
])
def test_a_motion_approaches_a_point_or_leaves_it(motion: Twist, point: tuple[float, float], approached: bool) -> None:
    assert OUTLINE.is_approached(*point, motion) is approached
