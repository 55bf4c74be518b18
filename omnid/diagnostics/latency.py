"""How old images are when something has come of them."""

from __future__ import annotations

import time

from omnid.engine.telemetry import Histogram
from omnid.messages import OdometryUpdate


class Latency:
    """A sink that measures from the capture of a pose's images to the pose; for stamps of CLOCK_MONOTONIC."""

    def __init__(self) -> None:
        self.to_pose = Histogram()

    def process(self, odometry: OdometryUpdate) -> None:
        """Takes the time."""
        self.to_pose.add((time.monotonic_ns() - odometry.stamp_ns) * 1e-9)
