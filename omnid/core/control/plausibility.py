"""Plausibility of pose, motor and motion for the control law: what it adds to the safety rules, and when to be slow."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

from omnid.core.control.heading_controller import Twist
from omnid.core.control.motion_monitor import AGREE, Motion, MotionMonitor, MotionSettings, Witness
from omnid.core.control.safety_rules import SafetyInputs
from omnid.core.control.trust import MotorTrust, PoseTrust, TrustSettings
from omnid.core.control.velocity_limits import VelocityLimits
from omnid.tracking_state import TrackingState

POSE_DEGRADED: Final = "the pose is degraded"
MOTION_DOUBTFUL: Final = "the motion that is seen or reported is not the commanded one"


class MotorReport(NamedTuple):
    """The part of a motor controller's status that is judged; NaN: the controller does not report this value."""

    motion: Motion
    fault: int = 0  # its own number; 0: none
    battery_v: float = float("nan")


class Plausibility:
    """Follows poses, commands and reports of the motor controller. Not thread-safe."""

    def __init__(self, trust: TrustSettings, motion: MotionSettings) -> None:
        self._settings = trust
        self._pose, self._motor = PoseTrust(trust), MotorTrust(trust)
        self._monitor = MotionMonitor(motion)
        self._degraded, self._checks = False, motion.check
        self.witness = AGREE  # witness of the newest pose

    @property
    def slowed_by(self) -> str:
        """The reason to drive slowly; empty without one."""
        if self._degraded:
            return POSE_DEGRADED
        return MOTION_DOUBTFUL if self._monitor.is_doubtful else self.witness.reason

    def add_pose(self, stamp_ns: int, state: str, seen: Motion, resets: int, witness: Witness = AGREE) -> None:
        """Take the next pose; a lost one says nothing about the motion."""
        self.witness = witness if self._checks else AGREE
        self._degraded = state == TrackingState.DEGRADED
        self._pose.add_pose(stamp_ns, seen.velocity_sigma_mps, seen.yaw_rate_sigma_radps, resets)
        if state != TrackingState.LOST:
            self._monitor.add_seen(stamp_ns, seen)

    def add_command(self, now_ns: int, motion: Twist) -> None:
        """Take the motion that was commanded."""
        self._monitor.add_command(now_ns, motion)

    def add_report(self, now_ns: int, report: MotorReport) -> None:
        """Take a report of the motor controller."""
        self._monitor.add_report(now_ns, report.motion)
        self._motor.add_report(now_ns, report.fault, report.battery_v)

    def added_to(self, inputs: SafetyInputs) -> SafetyInputs:
        """Return the inputs of the safety rules with these; a reset counts for one step."""
        return replace(
            inputs,
            pose_reset=self._pose.take_reset(),
            pose_unsure=self._pose.unsure,
            motor_faulty=self._motor.faulty,
            battery_empty=self._motor.battery_empty,
            disagreement=self._monitor.reason or (self.witness.reason if self.witness.is_fault else ""),
        )

    def slowed(self, wanted: Twist, limits: VelocityLimits) -> Twist:
        """Return the wanted motion within the limits, which are lower where there is a reason to drive slowly."""
        if not self.slowed_by:
            return wanted
        share = self._settings.degraded_speed
        return Twist(
            _clamp(wanted.velocity_mps, share * limits.velocity_mps),
            _clamp(wanted.yaw_rate_radps, share * limits.yaw_rate_radps),
        )


def _clamp(value: float, magnitude: float) -> float:
    return max(-magnitude, min(magnitude, value))
