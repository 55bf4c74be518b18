"""Processor time of the collision monitor in a tick of the controller: `python -m tests.benchmark.collision_tick`."""

from __future__ import annotations

import math
import pickle
import time
from typing import Final

from omnid.core.control.collision_monitor import CollisionMonitor
from omnid.core.control.collision_settings import CollisionSettings
from omnid.core.control.controller_ring import ControllerRing, MovingPoint
from omnid.core.control.heading_controller import Twist
from tests.benchmark.results import Column, ResultTable

TICKS: Final = 2000
S: Final = 1_000_000_000
CORRIDOR: Final = tuple(0.8 / max(abs(math.sin(math.radians(k - 179.5))), 0.2) for k in range(360))
MOVING: Final = tuple(MovingPoint(1.0 + 0.1 * i, 1.0, 0.0, -0.5, 0.25) for i in range(16))
RINGS: Final = {
    "free": ControllerRing(10 * S, (math.inf,) * 360),
    "corridor of 1.6 m": ControllerRing(10 * S, CORRIDOR),
    "all within 0.7 m": ControllerRing(10 * S, (0.7,) * 360),
    "all unknown": ControllerRing(10 * S, (math.nan,) * 360, (1.0,) * 360),
    "corridor, 16 moving obstacles": ControllerRing(10 * S, CORRIDOR, (), MOVING),
}


def tick_us(ring: ControllerRing, motion: Twist) -> float:
    """Return the mean processor time of a step, 0.2 s of ticks after the images."""
    monitor = CollisionMonitor(CollisionSettings(), 1.5)
    monitor.set_ring(ring)
    for tick in range(4):
        monitor.follow(10 * S + tick * S // 20, motion)
    start_ns = time.process_time_ns()
    for _ in range(TICKS):
        monitor.step(10 * S + S // 5, motion)
    return (time.process_time_ns() - start_ns) / TICKS / 1000


def receive_us(ring: ControllerRing) -> float:
    """Return the mean processor time to take a ring out of its message."""
    monitor, packet = CollisionMonitor(CollisionSettings(), 1.5), pickle.dumps(ring)
    start_ns = time.process_time_ns()
    for _ in range(TICKS // 10):
        monitor.set_ring(pickle.loads(packet))
    return (time.process_time_ns() - start_ns) / (TICKS // 10) / 1000


def main() -> None:
    """Print the table."""
    columns = ("straight on, a tick", "on an arc, a tick", "a new ring")
    table = ResultTable(
        "collision_tick",
        "speed",
        "Processor time of the collision monitor",
        (Column("ring"), *(Column(name, "us", 0) for name in columns)),
    )
    for name, ring in RINGS.items():
        table.add(name, tick_us(ring, Twist(0.5)), tick_us(ring, Twist(0.4, 0.6)), receive_us(ring))


if __name__ == "__main__":
    main()
