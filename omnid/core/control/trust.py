"""Trust in pose and motor: uncertainty, resets, the motor controller's faults and its battery."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from msgspec import Meta

from omnid.core.nanoseconds import S_PER_NS

# A voltage that is low for a shorter time is that of a motor that starts; by trial on development seeds.
BATTERY_S: Final = 2.0
OFF: Final = 0.0  # exact: the value of a setting that switches its rule off


@dataclass(frozen=True, slots=True)
class TrustSettings:
    """Levels at which the base slows down or stops."""

    degraded_speed: Annotated[
        float,
        Meta(ge=0.05, le=1),
        "share of the speed and yaw rate of controller.limits while the pose is degraded "
        "or some motion is unexplained; 1: no slowing",
    ] = 0.5
    velocity_sigma_mps: Annotated[
        float,
        Meta(ge=0, le=10),
        "the wheels stop when the standard deviation of the seen velocity stays higher, m/s; 0: never",
    ] = 0.2
    yaw_rate_sigma_radps: Annotated[float, Meta(ge=0, le=20), "the same of the yaw rate, rad/s; 0: never"] = 0.4
    sigma_s: Annotated[float, Meta(ge=0, le=10), "time for which a standard deviation may be higher, s"] = 0.3
    odometry_reset: Annotated[Literal["stop", "ignore"], "when odometry has lost its map and begins again"] = "stop"
    motor_fault: Annotated[Literal["stop", "ignore"], "when the motor controller reports a fault"] = "stop"
    battery_v: Annotated[
        float, Meta(ge=0, le=1000), "the wheels stop when the battery's voltage stays below, V; 0: never"
    ] = 0.0


class PoseTrust:
    """Follows uncertainty and resets from pose to pose."""

    def __init__(self, settings: TrustSettings) -> None:
        self._settings = settings
        self._unsure_since_ns: int | None = None
        self._newest_ns = 0
        self._resets: int | None = None
        self._reset = False

    @property
    def unsure(self) -> bool:
        """True if the velocity of the poses has been too uncertain for too long."""
        since_ns = self._unsure_since_ns
        return since_ns is not None and (self._newest_ns - since_ns) * S_PER_NS >= self._settings.sigma_s

    def add_pose(self, stamp_ns: int, velocity_sigma_mps: float, yaw_rate_sigma_radps: float, resets: int) -> None:
        """Take the next pose, with the standard deviations of its velocity and the count of resets."""
        settings = self._settings
        high = (settings.velocity_sigma_mps != OFF and not velocity_sigma_mps <= settings.velocity_sigma_mps) or (
            settings.yaw_rate_sigma_radps != OFF and not yaw_rate_sigma_radps <= settings.yaw_rate_sigma_radps
        )
        if not high:
            self._unsure_since_ns = None
        elif self._unsure_since_ns is None:
            self._unsure_since_ns = stamp_ns
        self._newest_ns = stamp_ns
        self._reset |= self._resets not in (None, resets) and settings.odometry_reset == "stop"
        self._resets = resets

    def take_reset(self) -> bool:
        """Return whether odometry has begun again since the last call."""
        reset, self._reset = self._reset, False
        return reset


class MotorTrust:
    """Follows the motor controller's fault and its battery."""

    def __init__(self, settings: TrustSettings) -> None:
        self._settings = settings
        self._low_since_ns: int | None = None
        self.faulty = False  # state of the last report
        self.battery_empty = False

    def add_report(self, now_ns: int, fault: int, battery_v: float) -> None:
        """Take a report of the motor controller; battery_v: NaN where it is unknown."""
        self.faulty = fault != 0 and self._settings.motor_fault == "stop"
        if self._settings.battery_v == OFF or not battery_v < self._settings.battery_v:
            self._low_since_ns, self.battery_empty = None, False
            return
        if self._low_since_ns is None:
            self._low_since_ns = now_ns
        self.battery_empty = (now_ns - self._low_since_ns) * S_PER_NS >= BATTERY_S
