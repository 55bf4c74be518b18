"""What the helm says of each of its ticks, and the book that is kept of them."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from drivers.motor import VelocityCommand
from omnid.core.control.safety_rules import IDLE
from omnid.engine.telemetry import Histogram, StageStats


@dataclass(slots=True)
class ControllerState:
    """How the wheels have fared so far."""

    reason: str = IDLE  # why they must stand now; empty: they may turn
    failed: bool = False  # the controller did not take the last command
    fault: int = 0  # the controller's own number
    sent: int = 0
    late: int = 0  # commands whose answer did not come in time, but soon
    errors: int = 0
    expiries: int = 0  # how often the controller had stopped by itself
    missed: int = 0  # ticks that were left out
    untold: int = 0  # ticks that nobody could be told of
    stops: Counter[str] = field(default_factory=Counter)  # of wheels that turned, by reason


class TickReport(NamedTuple):
    """What came of one tick."""

    command: VelocityCommand | None  # that the controller took
    late_s: float
    work_s: float
    to_wheel_s: float  # from the capture of a pose's images to this, the first command after it; else NaN
    account: ControllerState


class ControllerStatistics:
    """The book: the newest account, and how late, how long and how old things were."""

    def __init__(self, stats: StageStats) -> None:
        """stats: of the tick among the other stages; since the first it is busy until the next is heard of."""
        self.account = ControllerState()
        self.to_wheel = Histogram()
        self.lateness = Histogram()
        self._stats = stats

    def add(self, tick: TickReport) -> None:
        """One more tick."""
        self.account = tick.account
        self.lateness.add(tick.late_s)
        if math.isfinite(tick.to_wheel_s):
            self.to_wheel.add(tick.to_wheel_s)
        self._stats.wall.add(tick.work_s)
        self._stats.processed += 1
        self._stats.dropped = tick.account.missed
        self._stats.busy_since_ns = time.monotonic_ns()

    def close(self) -> None:
        """There will be no more."""
        self._stats.busy_since_ns = 0
