"""Trust in pose and motor: uncertainty, resets, faults, battery, and motion that does not fit together.

Commanded, reported and seen motion differ by plausible slip, delay and noise. A speed that was seen or reported is
plausible if it lies between the lowest and the highest expected speed of the last delay_s, widened by the slip, the
tolerance and three standard deviations. What lies beyond, integrated over time, is the unexplained motion in m and rad:
some of it slows the base down, more stops it. While nothing is unexplained, the sum falls again.

    commanded 0.3 m/s, seen 0: the slowest plausible speed is 0.3 (1 - 0.4) - 0.02 = 0.16 m/s: 0.16 m a second

The seen speed is that along x of the base, so the rig's T_base_rig must be right. Wheels that are not driven may be
pushed by hand: nothing is compared while the base is commanded to be at rest.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from itertools import chain, takewhile
from typing import Annotated, Final, Literal, NamedTuple, TypeAlias

from msgspec import Meta

from omnid.core.control.heading_controller import LONGEST_TICK_S, STOP, Twist, VelocityLimits
from omnid.core.nanoseconds import S_PER_NS
from omnid.tracking_state import TrackingState

MAX_MOTIONS: Final = 2048  # kept of each kind: 10 s at the highest rate of commands
SIGMAS: Final = 3.0  # Noise exceeds this in 0.3 % of the samples, so that false alarms are rare.
# Time in which disturbances pass: all unexplained motion is forgotten after so long at rest by command, and while
# nothing more is unexplained; a voltage that is low for so long is not that of a motor that starts.
REST_S: Final = 2.0
POSE_DEGRADED: Final = "the pose is degraded"
MOTION_DOUBTFUL: Final = "the motion that is seen or reported is not the commanded one"

POSE_RESET: Final = "odometry has lost its map and begun again"
POSE_UNSURE: Final = "the pose is too uncertain"
MOTOR_FAULT: Final = "the motor controller reports a fault"
BATTERY_EMPTY: Final = "the battery is empty"
NOT_SEEN: Final = "the images do not show the commanded motion"
NOT_COMMANDED: Final = "the images show a motion that was not commanded"
NOT_FOLLOWED: Final = "the wheels do not follow the commands"
COMPARED: Final = (NOT_SEEN, NOT_COMMANDED, NOT_FOLLOWED)
# Slow disagreement of images, wheels and gyro, in time, distance or turn (core/odometry/motion_agreement.py).
IMAGES_DIFFER: Final = "the images disagree with wheels and gyro"
WHEELS_DIFFER: Final = "the wheels disagree with images and gyro"
GYRO_DIFFERS: Final = "the gyro disagrees with images and wheels"
IMAGES_OR_WHEELS: Final = "images and wheels disagree"
IMAGES_OR_GYRO: Final = "images and gyro disagree"
IMAGES_ASIDE: Final = "the images show motion to the side"
CONFLICTS: Final = (IMAGES_DIFFER, WHEELS_DIFFER, GYRO_DIFFERS, IMAGES_OR_WHEELS, IMAGES_OR_GYRO, IMAGES_ASIDE)
DISAGREEMENTS: Final = (*COMPARED, *CONFLICTS)
ADVICE: Final = "check wheels, cameras, motor.drive, baseline and T_base_rig of the rig; see controller.motion"


class Difference(NamedTuple):
    """Motion that wheels or gyro report beyond what the images show."""

    amount: float = 0.0  # m or rad
    span_s: float = 0.0  # time, up to now, in which it has arisen

    def part(self, seconds: float) -> float:
        """Return the amount in a part of the span [s], the whole amount at most."""
        return self.amount * min(1.0, seconds / self.span_s) if self.span_s > 0 else 0.0


class Conflict(NamedTuple):
    """Slow disagreement of one sensor of the motion (images, wheels, gyro) with the others."""

    reason: str = ""  # one of CONFLICTS; empty: all agree
    detail: str = ""  # size of the disagreement, in words
    is_fault: bool = False  # False: a doubt
    distance: Difference = Difference()  # of the wheels; empty where they agree, or are late
    turn: Difference = Difference()  # of the gyro, else of the wheels

    @property
    def contradicts_images(self) -> bool:
        """True if the images contradict the others, and it is not known that the others are wrong."""
        return self.reason in (IMAGES_DIFFER, IMAGES_OR_WHEELS, IMAGES_OR_GYRO)


AGREE: Final = Conflict()


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """Plausible differences between commanded, reported and seen motion."""

    check: Annotated[bool, "compare the motion that is commanded, reported by the wheels and seen by the cameras"] = (
        True
    )
    delay_s: float = 0.5  # time after which the base must follow a command, s
    slip: Annotated[float, Meta(ge=0, le=0.95), "plausible slip of the wheels, as a share of the speed"] = 0.4
    speed_mps: float = 0.02  # difference in speed that means nothing, m/s
    yaw_rate_radps: float = 0.15  # difference in yaw rate that means nothing, rad/s
    stop_m: float = 0.15  # unexplained motion that stops the base, m; a third of it slows it down
    stop_rad: float = 0.5  # unexplained rotation that stops the base, rad; a third of it slows it down


class Motion(NamedTuple):
    """A motion that was seen or reported, with its standard deviations; NaN where it is unknown."""

    velocity_mps: float
    yaw_rate_radps: float
    velocity_sigma_mps: float = 0.0
    yaw_rate_sigma_radps: float = 0.0


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


# Time [ns], velocity [m/s] and yaw rate [rad/s] of a motion that was commanded or reported.
_TimedMotion: TypeAlias = tuple[int, float, float]


class Plausibility:
    """Judges poses, commands and reports of the motor controller: what stops the base, and what slows it down.

    The caller gives each tick's command, each pose and each report. The memory of motions is bounded. Not thread-safe.
    """

    def __init__(self, trust: TrustSettings, motion: MotionSettings) -> None:
        self._trust, self._settings = trust, motion
        self._commanded: deque[_TimedMotion] = deque(maxlen=MAX_MOTIONS)
        self._reported: deque[_TimedMotion] = deque(maxlen=MAX_MOTIONS)
        self._driven_ns: int | None = None  # the newest tick with a commanded motion
        self._last_seen_ns = self._last_report_ns = 0
        self._wheels_report = False  # whether the wheels have reported a motion: some controllers never do
        self._unexplained = {reason: [0.0, 0.0] for reason in COMPARED}  # m, rad
        # Since when the velocity has been too uncertain, and the battery low, by the stamps of the samples; the newest.
        self._unsure_ns: tuple[int, int] | None = None
        self._low_ns: tuple[int, int] | None = None
        self._resets: int | None = None
        self._is_degraded = self._is_reset = self._is_faulty = False
        self.reason = ""  # the unexplained motion for which the base must stop, until it was at rest for REST_S
        self.conflict = AGREE  # conflict of the newest pose

    @property
    def is_doubtful(self) -> bool:
        """True if some motion is unexplained: the base is to slow down."""
        limits = self._settings.stop_m, self._settings.stop_rad
        pairs = (pair for sums in self._unexplained.values() for pair in zip(sums, limits, strict=True))
        return any(3 * amount > limit for amount, limit in pairs)

    @property
    def slowed_by(self) -> str:
        """The reason to drive slowly; empty without one."""
        if self._is_degraded:
            return POSE_DEGRADED
        return MOTION_DOUBTFUL if self.is_doubtful else self.conflict.reason

    def slowed(self, wanted: Twist, limits: VelocityLimits) -> Twist:
        """Return the wanted motion within the limits, which are lower where there is a reason to drive slowly."""
        share = self._trust.degraded_speed if self.slowed_by else 1.0
        top_mps, top_radps = share * limits.velocity_mps, share * limits.yaw_rate_radps
        return replace(limits, velocity_mps=top_mps, yaw_rate_radps=top_radps).within(wanted)

    def take(self) -> set[str]:
        """Return the reasons to stop; a reset of odometry counts for one step."""
        conditions = {
            POSE_RESET: self._is_reset,
            POSE_UNSURE: _seconds(self._unsure_ns) >= self._trust.sigma_s,
            MOTOR_FAULT: self._is_faulty,
            BATTERY_EMPTY: _seconds(self._low_ns) >= REST_S,
            self.reason: True,
            self.conflict.reason: self.conflict.is_fault,
        }
        self._is_reset = False
        return {reason for reason, holds in conditions.items() if holds}

    def add_command(self, now_ns: int, motion: Twist) -> None:
        """Add the motion that was commanded at this tick."""
        if not self._settings.check:
            return
        self._commanded.append((now_ns, motion.velocity_mps, motion.yaw_rate_radps))
        if motion != STOP:
            self._driven_ns = now_ns
        if self._driven_ns is None or (now_ns - self._driven_ns) * S_PER_NS > REST_S:
            self.reason, self._unexplained = "", {reason: [0.0, 0.0] for reason in COMPARED}

    def add_pose(self, stamp_ns: int, state: str, seen: Motion, resets: int, conflict: Conflict = AGREE) -> None:
        """Add the next pose; resets: how often odometry has begun again. A lost pose says nothing about the motion."""
        trust = self._trust
        self.conflict = conflict if self._settings.check else AGREE
        self._is_degraded = state == TrackingState.DEGRADED
        # A NaN is uncertain; a level of 0 switches its rule off.
        levels = (
            (trust.velocity_sigma_mps, seen.velocity_sigma_mps),
            (trust.yaw_rate_sigma_radps, seen.yaw_rate_sigma_radps),
        )
        is_unsure = any(level > 0 and not sigma <= level for level, sigma in levels)
        self._unsure_ns = _lasting(self._unsure_ns, stamp_ns, is_unsure)
        self._is_reset |= self._resets not in (None, resets) and trust.odometry_reset == "stop"
        self._resets = resets
        # What the cameras saw until then is explained by what was commanded, or reported by the wheels.
        if state != TrackingState.LOST and stamp_ns > self._last_seen_ns:
            before_ns, self._last_seen_ns = self._last_seen_ns, stamp_ns
            explained = self._explained(stamp_ns, self._reported)
            self._compare(seen, explained, _passed_s(before_ns, stamp_ns), NOT_SEEN, NOT_COMMANDED)

    def add_report(self, now_ns: int, reported: Motion, fault: int, battery_v: float) -> None:
        """Add a report of the motor controller, whose motion is compared with what was commanded.

        A yaw rate of NaN is not compared; fault: 0 is none; battery_v: NaN where it is not reported.
        """
        self._is_faulty = fault != 0
        self._low_ns = _lasting(self._low_ns, now_ns, battery_v < self._trust.battery_v)
        before_ns, self._last_report_ns = self._last_report_ns, now_ns
        turn_radps = reported.yaw_rate_radps if math.isfinite(reported.yaw_rate_radps) else 0.0
        self._wheels_report |= reported.velocity_mps != 0.0 or turn_radps != 0.0
        if self._settings.check and self._wheels_report and math.isfinite(reported.velocity_mps):
            self._reported.append((now_ns, reported.velocity_mps, turn_radps))
            dt_s = _passed_s(before_ns, now_ns)
            self._compare(reported, self._explained(now_ns), dt_s, NOT_FOLLOWED, NOT_FOLLOWED)

    def _explained(self, at_ns: int, *others: deque[_TimedMotion]) -> list[_TimedMotion]:
        """Return the motions of commands and others within the delay before a time; none if none was commanded."""
        since_ns = at_ns - self._settings.delay_s / S_PER_NS
        recent = [
            [entry for entry in takewhile(lambda entry: entry[0] >= since_ns, reversed(motions)) if entry[0] <= at_ns]
            for motions in (self._commanded, *others)
        ]
        is_driven = any(velocity_mps or turn_radps for _, velocity_mps, turn_radps in recent[0])
        return list(chain(*recent)) if is_driven else []

    def _compare(
        self, found: Motion, explained: list[_TimedMotion], dt_s: float, too_little: str, too_much: str
    ) -> None:
        """Add the part of a motion that others do not explain to the sum of its reason; a speed of NaN is not compared.

        A slip of the slowest speed never changes its sign. too_little, too_much: the reasons of a motion that is slower
        or faster than explained; the sum of the reason that does not hold falls.
        """
        limits = self._settings
        axes = (
            (found.velocity_mps, limits.speed_mps + SIGMAS * found.velocity_sigma_mps, limits.stop_m),
            (found.yaw_rate_radps, limits.yaw_rate_radps + SIGMAS * found.yaw_rate_sigma_radps, limits.stop_rad),
        )
        for axis, (value, tolerance, limit) in enumerate(axes):
            if not explained or not math.isfinite(value):
                continue
            speeds = [motion[1 + axis] for motion in explained]
            low, high = min(speeds), max(speeds)
            low, high = low - limits.slip * abs(low) - tolerance, high + limits.slip * abs(high) + tolerance
            beyond = max(0.0, value - high) - max(0.0, low - value)
            of = too_little if beyond * (low + high) < 0.0 else too_much
            for reason in dict.fromkeys((too_little, too_much)):
                sums, adds = self._unexplained[reason], beyond != 0.0 and reason == of
                sums[axis] = max(0.0, sums[axis] + dt_s * (abs(beyond) if adds else -limit / REST_S))
                if sums[axis] > limit:
                    self.reason = self.reason or reason


def _passed_s(before_ns: int, now_ns: int) -> float:
    """Return the time between two samples, at most LONGEST_TICK_S: nothing is known of a longer gap."""
    return min(max(0.0, (now_ns - before_ns) * S_PER_NS), LONGEST_TICK_S)


def _lasting(since_ns: tuple[int, int] | None, now_ns: int, holds: bool) -> tuple[int, int] | None:
    """Return when a condition began to hold, and now; None where it does not hold."""
    return (now_ns if since_ns is None else since_ns[0], now_ns) if holds else None


def _seconds(since_ns: tuple[int, int] | None) -> float:
    return math.nan if since_ns is None else (since_ns[1] - since_ns[0]) * S_PER_NS
