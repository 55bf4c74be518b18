"""The control law as a whole: what its parts have to be told at each step."""

from __future__ import annotations

import math

from omnid.core.control.arming import AUTOMATIC
from omnid.core.control.collision_monitor import ControllerRing
from omnid.core.control.collision_settings import CollisionSettings
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.control_law import ControlLaw, ControllerPose, ControllerSettings
from omnid.core.control.heading_controller import Setpoint

TICK_NS, TICK_S = 20_000_000, 0.02
START_NS = 10**12
WALL_M = 1.0
WALL = tuple(WALL_M / math.cos(math.radians(k - 179.5)) if abs(k - 179.5) < 40 else math.inf for k in range(360))


def test_the_way_since_the_images_of_the_ring_counts() -> None:
    """One ring, a wall 1 m ahead: the base stops before the wall by its own motion, without another ring."""
    collision = CollisionSettings(stale_s=10.0)
    law = ControlLaw(ControllerSettings(arming=AUTOMATIC, collision=collision), START_NS)
    law.set_ring(ControllerRing(START_NS, WALL))
    driven_m = fastest_mps = 0.0
    for tick in range(1, 400):
        now_ns = START_NS + tick * TICK_NS
        law.set_pose(ControllerPose(now_ns, 0.0, 0.0, "tracking", law.motion.velocity_mps))
        law.set_command(TimedSetpoint(now_ns, Setpoint(0.5)))
        driven_m += law.step(now_ns, TICK_S).motion.velocity_mps * TICK_S
        fastest_mps = max(fastest_mps, law.motion.velocity_mps)
    assert law.motion.velocity_mps == 0.0 and fastest_mps > 0.15
    assert 0.3 < driven_m <= WALL_M - collision.front_m - collision.stop_m + 0.02
