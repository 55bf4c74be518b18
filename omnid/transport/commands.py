"""Commands from the network, validated: `<robot>/cmd/twist`, `/cmd/heading` and `/cmd/stop`.

twist is a geometry_msgs/msg/TwistStamped in base_link: linear.x m/s, angular.z rad/s. heading is a
geometry_msgs/msg/Vector3Stamped: x the speed in m/s, z the heading in odom in rad. stop may have any payload.
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

LONGEST_PAYLOAD: Final = 4096  # bytes
MAX_SPEED_MPS, MAX_YAW_RATE_RADPS, MAX_HEADING_RAD = 20.0, 50.0, 1000.0  # larger numbers are faults of the sender


class RefusedCommand(OmnidError):  # noqa: N818 - named after what it reports
    """A command that must not be executed; its first argument is the reason, which is counted."""


class CommandMessage(NamedTuple):
    """A decoded command and the time it was sent, by the sender's clock [ns of Unix time]."""

    stamp_ns: int
    setpoint: Setpoint


def twist_command(payload: bytes) -> CommandMessage:
    """Decode a speed and a yaw rate. Raise RefusedCommand or OmnidError for anything else."""
    stamp_ns, frame, velocity_mps, yaw_rate_radps = twist_from_cdr(payload)
    _check_frame(frame, "base_link")
    setpoint = Setpoint(_within(velocity_mps, MAX_SPEED_MPS), None, _within(yaw_rate_radps, MAX_YAW_RATE_RADPS))
    return CommandMessage(stamp_ns, setpoint)


def heading_command(payload: bytes) -> CommandMessage:
    """Decode a speed and a heading in odom. Raise RefusedCommand or OmnidError for anything else."""
    stamp_ns, frame, velocity_mps, heading_rad = heading_from_cdr(payload)
    _check_frame(frame, "odom")
    setpoint = Setpoint(_within(velocity_mps, MAX_SPEED_MPS), _within(heading_rad, MAX_HEADING_RAD))
    return CommandMessage(stamp_ns, setpoint)


def _within(value: float, limit: float) -> float:
    if not math.isfinite(value):
        raise RefusedCommand("not finite")
    if abs(value) > limit:
        raise RefusedCommand("out of range")
    return value


def _check_frame(frame: str, expected: str) -> None:
    if frame not in ("", expected):
        raise RefusedCommand("wrong frame")


class CommandReceiver:
    """Passes valid commands on and counts the others by reason; called from threads of the bus.

    on_setpoint receives the setpoint and its arrival, ns of CLOCK_MONOTONIC. Stops are always obeyed.
    """

    def __init__(
        self, on_setpoint: Callable[[Setpoint, int], None], on_stop: Callable[[], None], stale_s: float,
        *, synchronised: bool = True
    ) -> None:
        """stale_s: largest difference of a command's stamp from this machine's clock, before and after.

        synchronised: False where senders have other clocks. The stamps of each topic must then rise, so that a stream
        that was recorded earlier in this run is refused.
        """
        self._on_setpoint, self._on_stop, self._stale_ns = on_setpoint, on_stop, round(stale_s * 1e9)
        self._synchronised = synchronised
        self._newest_ns: dict[str, int] = {}  # stamp of the newest command that was accepted, by topic
        self._parsers = {"cmd/twist": twist_command, "cmd/heading": heading_command}
        self.accepted = self.stops = 0
        self.refused: Counter[str] = Counter()

    def receive(self, key: str, payload: bytes) -> None:
        """Handle one message; never raises."""
        arrival_ns = time.monotonic_ns()  # before anything else: a stop that arrives meanwhile voids the command
        if key == "cmd/stop":
            self.stops += 1
            self._on_stop()
            return
        try:
            command = self._parsed(key, payload)
        except RefusedCommand as refusal:
            self.refused[str(refusal)] += 1
            return
        except OmnidError:
            self.refused["malformed"] += 1
            return
        self.accepted += 1
        self._on_setpoint(command.setpoint, arrival_ns)

    def _parsed(self, key: str, payload: bytes) -> CommandMessage:
        if key not in self._parsers:
            raise RefusedCommand("unknown topic")
        if len(payload) > LONGEST_PAYLOAD:
            raise RefusedCommand("too long")
        command = self._parsers[key](payload)
        if self._synchronised:
            self._check_age(command.stamp_ns)
        else:
            self._check_order(key, command.stamp_ns)
        return command

    def _check_age(self, stamp_ns: int) -> None:
        age_ns = time.time_ns() - stamp_ns
        if age_ns > self._stale_ns:
            raise RefusedCommand("too old")
        if age_ns < -self._stale_ns:
            raise RefusedCommand("stamp in the future")

    def _check_order(self, key: str, stamp_ns: int) -> None:
        if key in self._newest_ns and stamp_ns <= self._newest_ns[key]:
            raise RefusedCommand("stamp does not rise")
        self._newest_ns[key] = stamp_ns
