"""Latency from the capture of images to the pose found in them."""

from __future__ import annotations

import time
from collections.abc import Callable

from omnid.engine.telemetry import Histogram
from omnid.messages import OdometryUpdate


class Latency:
    """A sink of poses; `to_pose` holds the latencies [s]."""

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """clock_ns: the clock of the poses' stamps."""
        self._clock_ns = clock_ns
        self.to_pose = Histogram()

    def process(self, odometry: OdometryUpdate) -> None:
        """Add the latency of a pose."""
        self.to_pose.add((self._clock_ns() - odometry.stamp_ns) * 1e-9)
