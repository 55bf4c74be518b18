"""Trust in pose and motor: uncertainty, resets, motion that does not fit together, the motor's faults and battery."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal, NamedTuple

from msgspec import Meta

from omnid.core.control.heading_controller import Twist, VelocityLimits
from omnid.core.control.motion_monitor import AGREE, Conflict, Motion, MotionMonitor, MotionSettings
from omnid.core.control.safety_rules import SafetyInputs
from omnid.core.nanoseconds import S_PER_NS
from omnid.tracking_state import TrackingState

# A voltage may be low for this time while a motor starts; by trial on development seeds.
BATTERY_S: Final = 2.0
POSE_DEGRADED: Final = "the pose is degraded"
MOTION_DOUBTFUL: Final = "the motion that is seen or reported is not the commanded one"


@dataclass(frozen=True, slots=True)
class TrustSettings:
    """Levels at which the base slows down or stops."""

    degraded_speed: float = 0.5  # share of the speeds while the pose is degraded or some motion is unexplained
    velocity_sigma_mps: Annotated[
        float,
        Meta(ge=0, le=10),
        "the wheels stop when the standard deviation of the seen velocity stays higher, m/s; 0: never",
    ] = 0.2
    yaw_rate_sigma_radps: Annotated[float, Meta(ge=0, le=20), "the same of the yaw rate, rad/s; 0: never"] = 0.4
    sigma_s: float = 0.3  # time for which a standard deviation may be higher, s
    odometry_reset: Annotated[Literal["stop", "ignore"], "when odometry has lost its map and begins again"] = "stop"
    battery_v: Annotated[
        float, Meta(ge=0, le=1000), "the wheels stop when the battery's voltage stays below, V; 0: never"
    ] = 0.0


class MotorReport(NamedTuple):
    """The part of a motor controller's status that is judged; NaN: the controller does not report this value."""

    motion: Motion
    fault: int = 0  # its own number; 0: none
    battery_v: float = math.nan


class Lasting:
    """For how long a condition has held without a break, by the stamps of its samples; NaN: it does not hold."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self.seconds = math.nan

    def add(self, now_ns: int, *, holds: bool) -> None:
        """Add a sample."""
        if not holds:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = now_ns
        self.seconds = math.nan if self._since_ns is None else (now_ns - self._since_ns) * S_PER_NS


class Plausibility:
    """Follows poses, commands and reports of the motor controller. Not thread-safe."""

    def __init__(self, trust: TrustSettings, motion: MotionSettings) -> None:
        self._settings, self._checks = trust, motion.check
        self.monitor = MotionMonitor(motion)  # takes the commands
        self._unsure, self._low = Lasting(), Lasting()  # velocity, battery
        self._resets: int | None = None
        self._is_degraded = self._is_reset = self._is_faulty = False
        self.conflict = AGREE  # conflict of the newest pose

    @property
    def slowed_by(self) -> str:
        """The reason to drive slowly; empty without one."""
        if self._is_degraded:
            return POSE_DEGRADED
        return MOTION_DOUBTFUL if self.monitor.is_doubtful else self.conflict.reason

    @property
    def disagreement(self) -> Conflict:
        """The measured disagreement for which the base stops or drives slowly."""
        return Conflict(self.monitor.reason, self.monitor.detail, True) if self.monitor.reason else self.conflict

    def add_pose(self, stamp_ns: int, state: str, seen: Motion, resets: int, conflict: Conflict = AGREE) -> None:
        """Add the next pose; resets: how often odometry has begun again. A lost pose says nothing about the motion."""
        settings = self._settings
        self.conflict = conflict if self._checks else AGREE
        self._is_degraded = state == TrackingState.DEGRADED
        # A NaN is uncertain; a level of 0 switches its rule off.
        levels = (
            (settings.velocity_sigma_mps, seen.velocity_sigma_mps),
            (settings.yaw_rate_sigma_radps, seen.yaw_rate_sigma_radps),
        )
        self._unsure.add(stamp_ns, holds=any(level > 0 and not sigma <= level for level, sigma in levels))
        self._is_reset |= self._resets not in (None, resets) and settings.odometry_reset == "stop"
        self._resets = resets
        if state != TrackingState.LOST:
            self.monitor.add_seen(stamp_ns, seen)

    def add_report(self, now_ns: int, report: MotorReport) -> None:
        """Add a report of the motor controller."""
        self.monitor.add_report(now_ns, report.motion)
        self._is_faulty = report.fault != 0
        self._low.add(now_ns, holds=report.battery_v < self._settings.battery_v)

    def added_to(self, inputs: SafetyInputs) -> SafetyInputs:
        """Return the inputs of the safety rules with the findings about pose and motor; a reset counts for one step."""
        is_reset, self._is_reset = self._is_reset, False
        return replace(
            inputs,
            pose_reset=is_reset,
            pose_unsure=self._unsure.seconds >= self._settings.sigma_s,
            motor_faulty=self._is_faulty,
            battery_empty=self._low.seconds >= BATTERY_S,
            disagreement=self.monitor.reason or (self.conflict.reason if self.conflict.is_fault else ""),
        )

    def slowed(self, wanted: Twist, limits: VelocityLimits) -> Twist:
        """Return the wanted motion within the limits, which are lower where there is a reason to drive slowly."""
        if not self.slowed_by:
            return wanted
        share = self._settings.degraded_speed
        top_mps, top_radps = share * limits.velocity_mps, share * limits.yaw_rate_radps
        return replace(limits, velocity_mps=top_mps, yaw_rate_radps=top_radps).within(wanted)
