"""Commands from the network, validated: `<robot>/cmd/twist`, `/cmd/heading`, `/cmd/stop` and `/cmd/arm`.

twist is a geometry_msgs/msg/TwistStamped in base_link: linear.x m/s, angular.z rad/s; or a plain Twist, whose stamp is
the time of sending that rmw_zenoh attaches. heading is a
geometry_msgs/msg/Vector3Stamped: x the speed in m/s, z the heading in odom in rad. Both also exist for each source of
commands, as cmd/planner/twist. stop may have any payload. arm is a std_msgs/msg/Header with the time it was sent.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol

from omnid.core.control.arming import OLDER_THAN_STOP, ArmRequest
from omnid.core.control.command_sources import OPERATOR, PLANNER, TimedSetpoint
from omnid.core.control.heading_controller import Setpoint
from omnid.errors import OmnidError
from omnid.transport.codec import (
    heading_from_cdr,
    is_plain_twist,
    plain_twist_from_cdr,
    stamp_from_cdr,
    twist_from_cdr,
)
from omnid.transport.topics import ARM, HEADING, STOP, TWIST

LONGEST_PAYLOAD: Final = 4096  # bytes
MOST_ARM_STAMPS: Final = 256  # remembered, where the senders' clocks are others
MAX_SPEED_MPS, MAX_YAW_RATE_RADPS, MAX_HEADING_RAD = 20.0, 50.0, 1000.0  # larger numbers are faults of the sender


MALFORMED: Final = "malformed"
UNSTAMPED: Final = "no stamp"
TOO_OLD, EARLY = "too old", "stamp in the future"
_CLOCKS: Final = 'synchronise the clocks, or set bus.command_clock = "arrival"'
_ADVICE: Final = {
    MALFORMED: "twist takes TwistStamped or Twist, heading Vector3Stamped, arm Header, as CDR",
    UNSTAMPED: f"fill in the stamp (`ros2 topic pub` needs `header: auto`), or {_CLOCKS.partition(', or ')[2]}",
    TOO_OLD: _CLOCKS,
    EARLY: _CLOCKS,
    "wrong frame": "give base_link for twist, odom for heading, or none",
    "unknown topic": "see controller.sources.names",
}
_MAX_KEY: Final = 60  # characters of a key in the log


class RefusedCommand(OmnidError):  # noqa: N818 - named after what it reports
    """A command that must not be executed; its first argument is the reason, which is counted."""


class CommandMessage(NamedTuple):
    """A decoded command and the time it was sent, by the sender's clock [ns of Unix time]; 0: it does not say it."""

    stamp_ns: int
    setpoint: Setpoint


def twist_command(payload: bytes) -> CommandMessage:
    """Decode a speed and a yaw rate. Raise RefusedCommand or OmnidError for anything else."""
    decode = plain_twist_from_cdr if is_plain_twist(payload) else twist_from_cdr
    stamp_ns, frame, velocity_mps, yaw_rate_radps = decode(payload)
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


class CommandTarget(Protocol):
    """The controller; its methods may be called from any thread."""

    def send_setpoint(self, command: TimedSetpoint) -> None:
        """Take a setpoint; its arrival is ns of CLOCK_MONOTONIC."""

    def stop(self) -> None:
        """Stop the wheels until `arm` is called later."""

    def arm(self, request: ArmRequest) -> None:
        """Take a request to arm."""


class CommandReceiver:
    """Passes valid commands on and counts the others by reason; called from threads of the bus.

    Stops are always obeyed. The controller decides which of several sources and senders drives.
    """

    def __init__(self, target: CommandTarget, stale_s: float, *, sources: Sequence[str] = (OPERATOR, PLANNER),
                 synchronised: bool = True, report: Callable[[str], None] | None = None) -> None:
        """stale_s: largest difference of a command's stamp from this machine's clock, before and after.

        sources: names; the first has the short topics cmd/twist and cmd/heading, too. synchronised: False where senders
        have other clocks. The stamps of each topic must then rise, so that a stream that was recorded earlier is
        refused; a request to arm lets them begin again, and needs a stamp that none of the last ones had. A plain Twist
        without stamp is accepted. report: takes lines for the log, one for each refusal.
        """
        self._report = report
        self._target, self._stale_ns, self._synchronised = target, round(stale_s * 1e9), synchronised
        self._newest_ns: dict[str, int] = {}  # stamp of the newest command that was accepted, by topic
        self._arm_stamps_ns: deque[int] = deque(maxlen=MOST_ARM_STAMPS)
        self._stop_ns = 0  # arrival of the newest stop
        parsers = {TWIST: twist_command, HEADING: heading_command}
        self._topics = {f"cmd/{name}": (sources[0], parser) for name, parser in parsers.items()}
        self._topics |= {f"cmd/{source}/{name}": (source, parser) for source in sources
                         for name, parser in parsers.items()}
        self.accepted = self.stops = self.arms = 0
        self.refused: Counter[str] = Counter()

    def receive(self, key: str, payload: bytes, sender: str = "", sent_ns: int = 0) -> None:
        """Handle one message; never raises.

        sender: identity of the program that sent it, empty if unknown. sent_ns: when, for a message without stamp.
        """
        arrival_ns = time.monotonic_ns()  # before anything else: a stop that arrives meanwhile voids the command
        if key == STOP:
            self._stop_ns = arrival_ns
            self.stops += 1
            self._target.stop()
            return
        try:
            if key == ARM:
                self._arm(payload, arrival_ns)
            else:
                self._drive(key, payload, arrival_ns, sender, sent_ns)
        except RefusedCommand as refusal:
            self._refuse(key, str(refusal))
        except OmnidError:
            self._refuse(key, MALFORMED)

    def _refuse(self, key: str, reason: str) -> None:
        self.refused[reason] += 1
        if self._report is not None:
            advice = f"; {_ADVICE[reason]}" if reason in _ADVICE else ""
            self._report(f"a command on {ascii(key)[1:-1][:_MAX_KEY]} is refused: {reason}{advice}")

    def _arm(self, payload: bytes, arrival_ns: int) -> None:
        _check_length(payload)
        stamp_ns = stamp_from_cdr(payload)
        if self._synchronised:
            age_ns = self._checked_age_ns(stamp_ns)
            if arrival_ns - age_ns <= self._stop_ns:
                raise RefusedCommand(OLDER_THAN_STOP)
        elif stamp_ns in self._arm_stamps_ns:
            raise RefusedCommand("stamp was used before")
        self._arm_stamps_ns.append(stamp_ns)
        self._newest_ns.clear()
        self.arms += 1
        self._target.arm(ArmRequest(arrival_ns, stamp_ns))

    def _drive(self, key: str, payload: bytes, arrival_ns: int, sender: str, sent_ns: int) -> None:
        if key not in self._topics:
            raise RefusedCommand("unknown topic")
        _check_length(payload)
        source, parser = self._topics[key]
        command = parser(payload)
        stamp_ns = command.stamp_ns or sent_ns
        if self._synchronised:
            if not stamp_ns:
                raise RefusedCommand(UNSTAMPED)
            self._checked_age_ns(stamp_ns)
        elif stamp_ns or not is_plain_twist(payload):
            self._check_order(key, stamp_ns)
        self.accepted += 1
        self._target.send_setpoint(TimedSetpoint(arrival_ns, command.setpoint, source, sender))

    def _checked_age_ns(self, stamp_ns: int) -> int:
        """Return the age of a stamp. Raise RefusedCommand where it is too old or from the future."""
        age_ns = time.time_ns() - stamp_ns
        if age_ns > self._stale_ns:
            raise RefusedCommand(TOO_OLD)
        if age_ns < -self._stale_ns:
            raise RefusedCommand(EARLY)
        return age_ns

    def _check_order(self, key: str, stamp_ns: int) -> None:
        if key in self._newest_ns and stamp_ns <= self._newest_ns[key]:
            raise RefusedCommand("stamp does not rise")
        self._newest_ns[key] = stamp_ns


def _check_length(payload: bytes) -> None:
    if len(payload) > LONGEST_PAYLOAD:
        raise RefusedCommand("too long")
