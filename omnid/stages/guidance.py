"""From a pose to a command: hold a heading at a bounded speed, stop when the pose is lost."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.motor import VelocityCommand, stop_command
from omnid.config import GuidanceConfig
from omnid.core.control.heading_controller import HeadingController, Setpoint, Twist
from omnid.messages import OdometryUpdate
from omnid.stages.odometry import of_base
from omnid.tracking_state import TrackingState


class Guidance:
    """Follows the setpoint of the configuration with the base that carries the rig."""

    def __init__(self, config: GuidanceConfig, T_base_rig: NDArray[np.float64]) -> None:
        self._setpoint = Setpoint(config.velocity_mps, math.radians(config.heading_deg))
        self._hold = HeadingController(config.limits)
        self._T_base_rig = T_base_rig
        self._drive = Twist()
        self._last_ns: int | None = None

    def process(self, odometry: OdometryUpdate) -> VelocityCommand:
        """The command that follows from a pose; a stop without one that can be trusted."""
        dt_s = 0.0 if self._last_ns is None else (odometry.stamp_ns - self._last_ns) * 1e-9
        self._last_ns = odometry.stamp_ns
        if odometry.state == TrackingState.LOST:
            self._drive = Twist()
            return stop_command(odometry.stamp_ns)
        heading_rad = float(se3.yaw(of_base(odometry, self._T_base_rig)[0]))
        self._drive = self._hold.step(self._setpoint, heading_rad, dt_s, self._drive)
        goal_rad = self._setpoint.heading_rad or 0.0
        return VelocityCommand(odometry.stamp_ns, self._drive.velocity_mps, goal_rad, self._drive.yaw_rate_radps)
