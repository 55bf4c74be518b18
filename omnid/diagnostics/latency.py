"""Latency from the capture of images to the pose found in them."""

from __future__ import annotations

import time

from omnid.engine.telemetry import Histogram
from omnid.messages import OdometryUpdate


class Latency:
    """A sink of poses whose stamps are CLOCK_MONOTONIC; `to_pose` holds the latencies [s]."""

    def __init__(self) -> None:
        self.to_pose = Histogram()

    def process(self, odometry: OdometryUpdate) -> None:
        """Add the latency of a pose."""
        self.to_pose.add((time.monotonic_ns() - odometry.stamp_ns) * 1e-9)
