"""What comes from the network, validated: commands and contacts below `<robot>/cmd`, samples of wheels and gyro.

twist is a geometry_msgs/msg/TwistStamped in base_link: linear.x m/s, angular.z rad/s; or a plain Twist, whose stamp is
the time of sending that rmw_zenoh attaches. heading is a
geometry_msgs/msg/Vector3Stamped: x the speed in m/s, z the heading in odom in rad. Both also exist for each source of
commands, as cmd/planner/twist. stop may have any payload. arm is a std_msgs/msg/Header with the time it was sent.
bumper and cliff are std_msgs/msg/Bool with the time of sending attached: all but a fresh False is a contact.

The times of sending obey one rule, `bus.command_clock`: what can begin or resume a motion needs a stamp of now, so that
a message that waited in a network, or was recorded, begins none later. What ends a motion needs none.

Samples are wheel_odom (nav_msgs/msg/Odometry), imu (Imu) and joint_states (JointState). They are below `cmd`, too,
because they move the pose while the cameras show nothing: only programs that may command the robot may write them.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol

from drivers.logs.ros_messages import JointWheels
from drivers.motion import MotionSample
from omnid.core.control.arming import OLDER_THAN_STOP, ArmRequest
from omnid.core.control.command_sources import OPERATOR, PLANNER, TimedSetpoint
from omnid.core.control.contacts import BUMPER, CLIFF
from omnid.core.control.heading_controller import Setpoint
from omnid.errors import OmnidError
from omnid.transport import topics
from omnid.transport.decode import (
    bool_from_cdr,
    heading_from_cdr,
    is_plain_twist,
    plain_twist_from_cdr,
    stamp_from_cdr,
    twist_from_cdr,
)
from omnid.transport.requests import Answer, Request
from omnid.transport.sensor_codec import sample_from_cdr
from omnid.transport.topics import ARM, HEADING, SENSOR_TOPICS, STOP, TWIST

UNSTAMPED: Final = "no stamp"
TOO_OLD, EARLY = "too old", "stamp in the future"
NOT_RISING: Final = "stamp does not rise"
USED_BEFORE: Final = "stamp was used before"
MOST_ARM_STAMPS: Final = 256  # remembered, where the senders' clocks are others
_CLOCKS: Final = (
    "on a busy computer try again; from another machine synchronise the clocks, or set bus.command_clock = "
    '"arrival"; controller.deadlines.command_s is the longest age'
)
ADVICE: Final = {
    UNSTAMPED: "fill in the stamp (ROS 2: `header: auto`; String: last word stamp=NANOSECONDS); for a plain Twist set "
    'bus.command_clock = "arrival"',
    TOO_OLD: _CLOCKS,
    EARLY: _CLOCKS,
    NOT_RISING: "one sender per topic, or arm the robot again for a sender whose clock began again",
}


class RefusedStamp(OmnidError):  # noqa: N818 - named after what it reports
    """A stamp that is not fresh; its first argument is the reason, which is counted."""


class StampRule:
    """Judges stamps, ns of Unix time by the sender's clock; 0: the message has none.

    Synchronised clocks: the stamp differs from this machine's clock by stale_s at most, before and after. Other clocks:
    the stamps of each topic rise; after a request to arm they may begin again lower, as of another sender, and that
    request needs a stamp that none of the last ones had.
    """

    def __init__(self, stale_s: float, *, synchronised: bool = True) -> None:
        self.synchronised = synchronised
        self._stale_ns = round(stale_s * 1e9)
        self._newest_ns: dict[str, int] = {}  # stamp of the newest message that was accepted, by topic
        self._arm_stamps_ns: deque[int] = deque(maxlen=MOST_ARM_STAMPS)

    def check(self, topic: str, stamp_ns: int) -> None:
        """Raise RefusedStamp for a message of a topic whose stamp is missing or not fresh."""
        if not stamp_ns:
            raise RefusedStamp(UNSTAMPED)
        if self.synchronised:
            self._check_age(stamp_ns)
            return
        if stamp_ns <= self._newest_ns.get(topic, 0):
            raise RefusedStamp(NOT_RISING)
        self._newest_ns[topic] = stamp_ns

    def check_arm(self, stamp_ns: int) -> None:
        """Raise RefusedStamp for a request to arm whose stamp is missing, not fresh or used before."""
        if not stamp_ns:
            raise RefusedStamp(UNSTAMPED)
        if self.synchronised:
            self._check_age(stamp_ns)
        elif stamp_ns in self._arm_stamps_ns:
            raise RefusedStamp(USED_BEFORE)

    def accept_arm(self, stamp_ns: int) -> None:
        """Remember a request to arm that was accepted; stamps may begin again after it."""
        self._arm_stamps_ns.append(stamp_ns)
        self._newest_ns.clear()

    def _check_age(self, stamp_ns: int) -> None:
        age_ns = time.time_ns() - stamp_ns
        if age_ns > self._stale_ns:
            raise RefusedStamp(TOO_OLD)
        if age_ns < -self._stale_ns:
            raise RefusedStamp(EARLY)


LONGEST_PAYLOAD: Final = 4096  # bytes
LONGEST_SAMPLE: Final = 8192  # bytes
MAX_SPEED_MPS, MAX_YAW_RATE_RADPS, MAX_HEADING_RAD = 20.0, 50.0, 1000.0  # larger numbers are faults of the sender


MALFORMED: Final = "malformed"
SAME_NAME: Final = "another robot has this name"
_ADVICE: Final = ADVICE | {
    MALFORMED: "twist takes TwistStamped or Twist, heading Vector3Stamped, arm Header, bumper and cliff Bool, as CDR",
    SAME_NAME: "change bus.robot of one of them",
    "wrong frame": "give base_link for twist, odom for heading, or none",
    "unknown topic": "see controller.sources.names",
}
_CONTACTS: Final = {topics.BUMPER: BUMPER, topics.CLIFF: CLIFF}
_MAX_TOPIC: Final = 60  # characters of a topic in the log


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

    def touch(self, contact: str, *, holds: bool) -> None:
        """Take the state of a bumper or a cliff sensor."""


class CommandReceiver:
    """Passes valid commands on and counts the others by reason; called from threads of the bus.

    Stops are always obeyed. The controller decides which of several sources and senders drives.
    """

    def __init__(
        self,
        target: CommandTarget,
        stamps: StampRule,
        *,
        sources: Sequence[str] = (OPERATOR, PLANNER),
        report: Callable[[str], None] | None = None,
        is_unique: Callable[[], bool] = lambda: True,
    ) -> None:
        """stamps: the rule for the stamps; where the clocks differ, a plain Twist without stamp is accepted.

        sources: names; the first has the short topics cmd/twist and cmd/heading, too. report: takes lines for the log,
        one for each refusal. is_unique: False while another robot has this one's name, which is then not armed.
        """
        self._report, self._is_unique = report, is_unique
        self._target, self._stamps = target, stamps
        self._stop_ns = 0  # arrival of the newest stop
        parsers = {TWIST: twist_command, HEADING: heading_command}
        self._topics = {f"cmd/{name}": (sources[0], parser) for name, parser in parsers.items()}
        self._topics |= {
            f"cmd/{source}/{name}": (source, parser) for source in sources for name, parser in parsers.items()
        }
        self.accepted = self.stops = self.arms = 0
        self.refused: Counter[str] = Counter()
        self._touched_ns: dict[str, int] = {}  # newest stamp of a contact, by topic

    def receive(self, request: Request) -> Answer | None:
        """Handle one message, never raises; return the refusal, None where there is none or the target decides."""
        # Before anything else: a stop that arrives meanwhile voids the command. Both clocks are read at once, for the
        # time at which a request was sent is computed by their difference.
        arrival_ns, unix_ns = time.monotonic_ns(), time.time_ns()
        if request.topic == STOP:
            self._stop_ns = arrival_ns
            self.stops += 1
            self._target.stop()
            return None
        try:
            if request.topic in _CONTACTS:
                self._touch(request)
            elif request.topic == ARM:
                self._arm(request, arrival_ns, unix_ns)
            else:
                self._drive(request, arrival_ns)
        except (RefusedCommand, RefusedStamp) as refusal:
            return self._refuse(request.topic, str(refusal))
        except OmnidError:
            return self._refuse(request.topic, MALFORMED)
        return None

    def _refuse(self, topic: str, reason: str) -> Answer:
        self.refused[reason] += 1
        text = f"{reason}; {_ADVICE[reason]}" if reason in _ADVICE else reason
        if self._report is not None:
            self._report(f"a command on {ascii(topic)[1:-1][:_MAX_TOPIC]} is refused: {text}")
        return Answer(False, text)

    def _touch(self, request: Request) -> None:
        """Pass the state of a contact on.

        A contact ends only by a Bool of False with a fresh stamp, which is not older than that of the contact, because
        messages may overtake each other. All other messages are a contact.
        """
        holds = True
        try:
            _check_length(request.payload)
            newest_ns = self._touched_ns.get(request.topic, 0)
            if bool_from_cdr(request.payload):
                latest_ns = time.time_ns() if self._stamps.synchronised else request.sent_ns
                self._touched_ns[request.topic] = max(newest_ns, min(request.sent_ns, latest_ns))
            else:
                self._stamps.check(request.topic, request.sent_ns)
                holds = request.sent_ns < newest_ns
        finally:
            self._target.touch(_CONTACTS[request.topic], holds=holds)

    def _arm(self, request: Request, arrival_ns: int, unix_ns: int) -> None:
        _check_length(request.payload)
        stamp_ns = stamp_from_cdr(request.payload)
        self._stamps.check_arm(stamp_ns)
        if not self._is_unique():
            raise RefusedCommand(SAME_NAME)
        if self._stamps.synchronised and arrival_ns - (unix_ns - stamp_ns) <= self._stop_ns:
            raise RefusedCommand(OLDER_THAN_STOP)
        self._stamps.accept_arm(stamp_ns)
        if not self._stamps.synchronised:
            self._touched_ns.clear()  # a sender whose clock began again may release, too
        self.arms += 1
        self._target.arm(ArmRequest(arrival_ns, request.id))

    def _drive(self, request: Request, arrival_ns: int) -> None:
        topic, payload = request.topic, request.payload
        if topic not in self._topics:
            raise RefusedCommand("unknown topic")
        _check_length(payload)
        source, parser = self._topics[topic]
        command = parser(payload)
        stamp_ns = command.stamp_ns or request.sent_ns
        if stamp_ns or self._stamps.synchronised or not is_plain_twist(payload):
            self._stamps.check(topic, stamp_ns)
        self.accepted += 1
        self._target.send_setpoint(TimedSetpoint(arrival_ns, command.setpoint, source, request.sender))


def _check_length(payload: bytes) -> None:
    if len(payload) > LONGEST_PAYLOAD:
        raise RefusedCommand("too long")


class SensorReceiver:
    """Passes valid samples on and counts the others; called from threads of the bus, never raises."""

    def __init__(
        self,
        target: Callable[[MotionSample], None],
        offset_ns: int,
        topics: frozenset[str],
        report: Callable[[str], None],
        joints: JointWheels | None = None,
    ) -> None:
        """target: may be called from any thread. offset_ns: from the stamps of images to Unix time.

        topics: those that are used. report: takes a line for the log, once for each topic. joints: the wheels.
        """
        self._joints = joints
        self._target, self._offset_ns, self._topics, self._report = target, offset_ns, topics, report
        self.refused: Counter[str] = Counter()  # by topic

    def receive(self, key: str, payload: bytes) -> None:
        """Handle one message."""
        try:
            if key not in self._topics:
                raise OmnidError("it is not used: see motion.wheels, motion.wheel_joints and motion.imu")
            if len(payload) > LONGEST_SAMPLE:
                raise OmnidError(f"it has {len(payload)} bytes, more than {LONGEST_SAMPLE}")
            sample = sample_from_cdr(payload, SENSOR_TOPICS[key], self._offset_ns, self._joints)
        except OmnidError as error:
            self.refused[key] += 1
            if self.refused[key] == 1:
                self._report(f"a message on {key} is refused: {error}; more of them are counted in the status")
            return
        if sample is not None:
            self._target(sample)
