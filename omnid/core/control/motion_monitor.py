"""Comparison of the motion that is commanded, reported by the wheels, and seen by the cameras.

The three differ by plausible slip, delay and noise. A speed that was seen or reported is plausible if it lies between
the lowest and the highest expected speed of the last delay_s, widened by the slip, the tolerance and three standard
deviations. What lies beyond, integrated over time, is the unexplained motion in m and rad: some of it slows the base
down, more stops it. While nothing is unexplained, the sum falls again.

    commanded 0.3 m/s, seen 0: the slowest plausible speed is 0.3 (1 - 0.4) - 0.02 = 0.16 m/s: 0.16 m a second

The seen speed is that along x of the base, so the rig's T_base_rig must be right. Wheels that are not driven may be
pushed by hand: nothing is compared while the base is commanded to stand.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import takewhile
from typing import Annotated, Final, NamedTuple, TypeAlias

from msgspec import Meta

from omnid.core.control.heading_controller import LONGEST_TICK_S, STOP, Twist
from omnid.core.nanoseconds import S_PER_NS

MAX_MOTIONS: Final = 2048  # kept of each kind: 10 s at the highest rate of commands
SIGMAS: Final = 3.0  # Noise exceeds this in 0.3 % of the samples, so that false alarms are rare.
# Fraction of the stopping limit by which the sum falls per second while nothing is unexplained; by trial on development
# seeds.
RECOVERY: Final = 0.5
# After this time at rest by command, all unexplained motion is forgotten; by trial on development seeds.
REST_S: Final = 2.0

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
    slow_m: float = 0.05  # unexplained motion that slows the base down, m
    stop_m: float = 0.15  # unexplained motion that stops the base, m
    slow_rad: float = 0.15  # unexplained rotation that slows the base down, rad
    stop_rad: float = 0.5  # unexplained rotation that stops the base, rad


class Motion(NamedTuple):
    """A motion that was seen or reported, with its standard deviations; NaN where it is unknown."""

    velocity_mps: float
    yaw_rate_radps: float
    velocity_sigma_mps: float = 0.0
    yaw_rate_sigma_radps: float = 0.0


# Time [ns], velocity [m/s] and yaw rate [rad/s] of a motion that was commanded or reported.
_TimedMotion: TypeAlias = tuple[int, float, float]


class MotionMonitor:
    """Sums of unexplained motion; the caller gives each tick's command, each pose and each report of the wheels.

    The memory of commands is bounded. Not thread-safe.
    """

    def __init__(self, settings: MotionSettings) -> None:
        self._settings = settings
        self._commanded: deque[_TimedMotion] = deque(maxlen=MAX_MOTIONS)
        self._reported: deque[_TimedMotion] = deque(maxlen=MAX_MOTIONS)
        self._driven_ns: int | None = None  # the newest tick with a commanded motion
        self._last_seen_ns = self._last_report_ns = 0
        self._wheels_report = False  # whether the wheels have reported a motion: some controllers never do
        self._unexplained = {reason: [0.0, 0.0] for reason in COMPARED}  # m, rad
        self.reason = ""  # the disagreement for which the base must stop, until it has stood for REST_S
        self.detail = ""  # the motions that disagree

    @property
    def is_doubtful(self) -> bool:
        """True if some motion is unexplained: the base is to slow down."""
        return any(
            metres > self._settings.slow_m or radians > self._settings.slow_rad
            for metres, radians in self._unexplained.values()
        )

    def add_command(self, now_ns: int, motion: Twist) -> None:
        """Add the motion that was commanded at this tick."""
        if not self._settings.check:
            return
        self._commanded.append((now_ns, motion.velocity_mps, motion.yaw_rate_radps))
        if motion != STOP:
            self._driven_ns = now_ns
        if self._driven_ns is None or (now_ns - self._driven_ns) * S_PER_NS > REST_S:
            self._forget()

    def add_seen(self, stamp_ns: int, seen: Motion) -> None:
        """Compare what the cameras saw at a time with what was commanded, or reported by the wheels, until then."""
        before_ns, self._last_seen_ns = self._last_seen_ns, max(stamp_ns, self._last_seen_ns)
        if stamp_ns <= before_ns or not self._drives_at(stamp_ns):
            return
        explained = [*self._recent(self._commanded, stamp_ns), *self._recent(self._reported, stamp_ns)]
        self._compare(seen, explained, _passed_s(before_ns, stamp_ns), NOT_SEEN, NOT_COMMANDED)

    def add_report(self, now_ns: int, reported: Motion) -> None:
        """Compare what the wheels report with what was commanded; a yaw rate of NaN is not compared."""
        if not self._settings.check:
            return
        before_ns, self._last_report_ns = self._last_report_ns, now_ns
        turn_radps = reported.yaw_rate_radps if math.isfinite(reported.yaw_rate_radps) else 0.0
        self._wheels_report |= reported.velocity_mps != 0.0 or turn_radps != 0.0
        if not self._wheels_report or not math.isfinite(reported.velocity_mps):
            return
        self._reported.append((now_ns, reported.velocity_mps, turn_radps))
        if not self._drives_at(now_ns):
            return
        explained, dt_s = self._recent(self._commanded, now_ns), _passed_s(before_ns, now_ns)
        self._compare(reported, explained, dt_s, NOT_FOLLOWED, NOT_FOLLOWED)

    def _drives_at(self, at_ns: int) -> bool:
        """True if a motion was commanded within the delay before a time."""
        return any(velocity_mps or turn_radps for _, velocity_mps, turn_radps in self._recent(self._commanded, at_ns))

    def _recent(self, motions: deque[_TimedMotion], at_ns: int) -> list[_TimedMotion]:
        """Return the motions within the delay before a time, the newest first."""
        since_ns = at_ns - self._settings.delay_s / S_PER_NS
        return [
            entry for entry in takewhile(lambda entry: entry[0] >= since_ns, reversed(motions)) if entry[0] <= at_ns
        ]

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
            if not math.isfinite(value):
                continue
            speeds = [motion[1 + axis] for motion in explained]
            low, high = min(speeds), max(speeds)
            low, high = low - limits.slip * abs(low) - tolerance, high + limits.slip * abs(high) + tolerance
            beyond = max(0.0, value - high) - max(0.0, low - value)
            of = too_little if beyond * (low + high) < 0.0 else too_much
            for reason in {too_little: None, too_much: None}:
                sums, adds = self._unexplained[reason], beyond != 0.0 and reason == of
                sums[axis] = max(0.0, sums[axis] + dt_s * (abs(beyond) if adds else -RECOVERY * limit))
                if sums[axis] > limit and not self.reason:
                    what = "reported" if reason == NOT_FOLLOWED else "seen"
                    mean = (sum(motion[part] for motion in explained) / len(explained) for part in (1, 2))
                    moved = found.velocity_mps, found.yaw_rate_radps
                    self.reason, self.detail = reason, f"({what} {_words(*moved)}, expected {_words(*mean)})"

    def _forget(self) -> None:
        self.reason = self.detail = ""
        for sums in self._unexplained.values():
            sums[:] = 0.0, 0.0


def _words(velocity_mps: float, yaw_rate_radps: float) -> str:
    return f"{velocity_mps:+.2f} m/s {yaw_rate_radps:+.2f} rad/s"


def _passed_s(before_ns: int, now_ns: int) -> float:
    """Return the time between two samples, at most LONGEST_TICK_S: nothing is known of a longer gap."""
    return min(max(0.0, (now_ns - before_ns) * S_PER_NS), LONGEST_TICK_S)
