"""The commands that the controller gives on a log's own clock: the control law in lock-step with the poses.

One law, two clocks. `omnid run` and `omnid replay --motor` step the law in the controller process, in real time, and
send what it gives to the motor controller. This stage steps the same law on the stamps of the log, so that what a
replay publishes and records as `<robot>/drive` is a function of log and configuration alone: threaded and inline runs,
on a fast and on a slow host, with and without --motor, give the same bytes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.motor import VelocityCommand
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.control_law import (
    ControlLaw,
    ControllerPose,
    ControllerSettings,
    ControlOutput,
)
from omnid.core.control.heading_controller import STOP
from omnid.core.frames import of_base
from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.messages import OdometryUpdate
from omnid.tracking_state import TrackingState


class LockstepDrive:
    """Follow the setpoint of the configuration with the base that carries the rig.

    The law ticks at the motor's rate between two poses as well, so that a gap in the log stops the wheels as it does
    on the robot: after controller.deadlines.pose_s, within the deceleration.
    """

    def __init__(self, settings: ControllerSettings, period_s: float, T_base_rig: NDArray[np.float64]) -> None:
        """period_s: between two ticks."""
        self._setpoint, self._T_base_rig = settings.setpoint.setpoint(), T_base_rig
        self._period_ns = round(period_s * NS_PER_S)
        self._law = ControlLaw(settings.of_replay, start_ns=-1)
        self._last_ns: int | None = None

    def process(self, odometry: OdometryUpdate) -> VelocityCommand:
        """Return the command that follows from a pose, at its stamp."""
        # 1. The ticks since the last pose, by which a gap in the log stops the wheels.
        stamp_ns = odometry.stamp_ns
        self._tick_until(stamp_ns)
        # 2. The tick at this pose, whose command is recorded.
        self._law.take(controller_pose(odometry, self._T_base_rig))
        output = self._step(stamp_ns)
        return VelocityCommand(stamp_ns, output.motion.velocity_mps, output.heading_rad, output.motion.yaw_rate_radps)

    def _tick_until(self, stamp_ns: int) -> None:
        """Tick between the last pose and the next; ticks are omitted once the wheels are at rest."""
        if self._last_ns is None:
            return
        ticks = range(self._last_ns + self._period_ns, stamp_ns, self._period_ns)
        for tick_ns in ticks:
            output = self._step(tick_ns)
            if output.reason and output.motion == STOP:
                self._last_ns = ticks[-1]
                return

    def _step(self, now_ns: int) -> ControlOutput:
        dt_s = 0.0 if self._last_ns is None else (now_ns - self._last_ns) * S_PER_NS
        self._last_ns = now_ns
        self._law.take(TimedSetpoint(now_ns, self._setpoint))
        return self._law.step(now_ns, dt_s)


def controller_pose(odometry: OdometryUpdate, T_base_rig: NDArray[np.float64]) -> ControllerPose:
    """Return the part of a pose that the controller needs; one that is not finite is LOST."""
    T_odom_base, _, velocity, covariance = of_base(odometry, T_base_rig)
    heading_rad, velocity_mps, rate_radps = float(se3.yaw(T_odom_base)), float(velocity[0]), float(velocity[5])
    # The order of max: it returns its first argument where that is NaN.
    sigma_mps, sigma_radps = (math.sqrt(max(float(covariance[axis, axis]), 0.0)) for axis in (0, 5))
    finite = all(map(math.isfinite, (heading_rad, velocity_mps, rate_radps, sigma_mps, sigma_radps)))
    return ControllerPose(
        odometry.stamp_ns,
        heading_rad,
        rate_radps,
        odometry.state if finite else TrackingState.LOST,
        velocity_mps,
        sigma_mps,
        sigma_radps,
        odometry.reset_counter,
        odometry.conflict,
    )
