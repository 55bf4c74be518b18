"""Actions at a fixed rate, each in a thread that the graph starts."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from omnid.engine.flow import nothing
from omnid.engine.telemetry import StageStats
from omnid.errors import OmnidError


class Ticker:
    """Calls an action at a fixed rate, independent of the stages.

    The graph calls the action's optional `close` once, also after an error. `stats.dropped` counts missed deadlines.
    """

    def __init__(self, name: str, period_s: float, action: Callable[[], object]) -> None:
        if not 0.0 < period_s < threading.TIMEOUT_MAX:
            raise OmnidError(f"ticker '{name}': expected a period above 0 s, found {period_s}")
        self.name = name
        self.stats = StageStats(name)
        self._period_ns = round(period_s * 1e9)
        self._action = action
        self._halt = threading.Event()

    def halt(self) -> None:
        """End `run` before its next tick."""
        self._halt.set()

    def run(self, stopping: Callable[[], bool]) -> None:
        """Tick until halted or stopping."""
        deadline_ns = time.monotonic_ns()
        while not self._halt.wait(max(0.0, (deadline_ns - time.monotonic_ns()) * 1e-9)) and not stopping():
            skipped = skipped_deadlines(deadline_ns, time.monotonic_ns(), self._period_ns)
            self.stats.dropped += skipped
            self.stats.busy_since_ns = time.monotonic_ns()
            self.stats.timed(self._action)
            self.stats.busy_since_ns = 0
            deadline_ns += (1 + skipped) * self._period_ns

    def close(self) -> None:
        """Close the action."""
        getattr(self._action, "close", nothing)()


def skipped_deadlines(deadline_ns: int, now_ns: int, period_ns: int) -> int:
    """Return how many deadlines to skip so that the newest one passed is served now, without drift and burst."""
    return max(0, now_ns - deadline_ns) // period_ns
