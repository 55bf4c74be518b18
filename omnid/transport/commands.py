"""Commands from the network: `<robot>/cmd/twist`, `/cmd/heading` and `/cmd/stop`, judged before anybody obeys them.

twist is a geometry_msgs/msg/TwistStamped in base_link: linear.x m/s, angular.z rad/s. heading is a
geometry_msgs/msg/Vector3Stamped: x the speed in m/s, z the heading in odom in rad. stop is any payload at all.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Final, NamedTuple

from omnid.core.control.heading_controller import Setpoint
from omnid.errors import OmnidError
from omnid.transport.codec import heading_from_cdr, twist_from_cdr

LONGEST_PAYLOAD: Final = 4096
ANY_SPEED_MPS, ANY_RATE_RADPS, ANY_HEADING_RAD = 20.0, 50.0, 1000.0  # beyond these a number is no wish but a fault
SAME_CLOCK_S = 60.0  # a stamp that far from now is of another clock, or of none: the arrival alone counts


class RefusedCommand(OmnidError):  # noqa: N818 - it is what becomes of the command
    """A command that nobody should obey; its first argument is the reason, for counting."""


class Wish(NamedTuple):
    """A command and when it was sent, by the sender's clock [ns of Unix time]."""

    stamp_ns: int
    setpoint: Setpoint


def twist_command(payload: bytes) -> Wish:
    """A speed and a yaw rate; Refused where it is neither."""
    stamp_ns, frame, velocity_mps, yaw_rate_radps = twist_from_cdr(payload)
    _expect_frame(frame, "base_link")
    setpoint = Setpoint(_within(velocity_mps, ANY_SPEED_MPS), None, _within(yaw_rate_radps, ANY_RATE_RADPS))
    return Wish(stamp_ns, setpoint)


def heading_command(payload: bytes) -> Wish:
    """A speed and a heading in odom; Refused where it is neither."""
    stamp_ns, frame, velocity_mps, heading_rad = heading_from_cdr(payload)
    _expect_frame(frame, "odom")
    return Wish(stamp_ns, Setpoint(_within(velocity_mps, ANY_SPEED_MPS), _within(heading_rad, ANY_HEADING_RAD)))


def _within(value: float, most: float) -> float:
    if not math.isfinite(value):
        raise RefusedCommand("not finite")
    if abs(value) > most:
        raise RefusedCommand("out of range")
    return value


def _expect_frame(frame: str, expected: str) -> None:
    if frame not in ("", expected):
        raise RefusedCommand("another frame")


class Commands:
    """Hands good commands on, counts the others by reason; called from the bus's threads.

    obey gets the setpoint and its arrival, ns of CLOCK_MONOTONIC.
    """

    def __init__(self, obey: Callable[[Setpoint, int], None], stop: Callable[[], None], stale_s: float) -> None:
        self._obey, self._stop, self._stale_s = obey, stop, stale_s
        self._parsers = {"cmd/twist": twist_command, "cmd/heading": heading_command}
        self.accepted = self.stops = 0
        self.refused: Counter[str] = Counter()

    def take(self, key: str, payload: bytes) -> None:
        """One command as it came; never raises."""
        arrival_ns = time.monotonic_ns()  # before anything else: a stop that comes meanwhile voids it
        if key == "cmd/stop":
            self.stops += 1
            self._stop()
            return
        try:
            wish = self._judged(key, payload)
        except RefusedCommand as refusal:
            self.refused[str(refusal)] += 1
            return
        except OmnidError:
            self.refused["malformed"] += 1
            return
        self.accepted += 1
        self._obey(wish.setpoint, arrival_ns)

    def _judged(self, key: str, payload: bytes) -> Wish:
        if key not in self._parsers:
            raise RefusedCommand("unknown")
        if len(payload) > LONGEST_PAYLOAD:
            raise RefusedCommand("too long")
        wish = self._parsers[key](payload)
        age_s = time.time() - wish.stamp_ns * 1e-9
        if self._stale_s < age_s < SAME_CLOCK_S:
            raise RefusedCommand("sent long ago")
        return wish
