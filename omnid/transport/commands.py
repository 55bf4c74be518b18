"""What comes from the network, validated: commands and contacts below `<robot>/cmd`, samples of wheels and gyro.

twist is a geometry_msgs/msg/TwistStamped in base_link: linear.x m/s, angular.z rad/s; or a plain Twist, whose stamp is
the time of sending that rmw_zenoh attaches. heading is a
geometry_msgs/msg/Vector3Stamped: x the speed in m/s, z the heading in odom in rad. Both also exist for each source of
commands, as cmd/planner/twist. stop may have any payload. arm is a std_msgs/msg/Header with the time it was sent.
bumper and cliff are std_msgs/msg/Bool with the time of sending attached: all but a fresh False is a contact.

When a message was sent is judged by one rule (omnid.transport.freshness): what can begin or resume a motion must have
been sent just now, what goes on with one is at least as old as its arrival, what ends one is taken in any case.

Samples are wheel_odom (nav_msgs/msg/Odometry), imu (Imu) and joint_states (JointState). They are below `cmd`, too,
because they move the pose while the cameras show nothing: only programs that may command the robot may write them.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple, Protocol

from drivers.logs.ros_messages import JointWheels
from drivers.motion import MotionSample
from omnid.core.control.arming import OLDER_THAN_STOP, ArmRequest
from omnid.core.control.command_sources import OPERATOR, PLANNER, TimedSetpoint
from omnid.core.control.contacts import BUMPER, CLIFF
from omnid.core.control.heading_controller import Setpoint
from omnid.errors import OmnidError
from omnid.transport import topics
from omnid.transport.codec import ASIDE_NAMES, bool_from_cdr, heading_from_cdr, stamp_from_cdr, twist_from_cdr
from omnid.transport.freshness import Freshness
from omnid.transport.requests import Answer, Refused, Request
from omnid.transport.sensor_codec import sample_from_cdr
from omnid.transport.topics import ARM, HEADING, SENSOR_TOPICS, STOP, TWIST, setpoint_topics

LONGEST_PAYLOAD: Final = 4096  # bytes
LONGEST_SAMPLE: Final = 8192  # bytes
MAX_SPEED_MPS, MAX_YAW_RATE_RADPS, MAX_HEADING_RAD = 20.0, 50.0, 1000.0  # larger numbers are faults of the sender
LEAST_SPEED: Final = 1e-3  # m/s, rad/s; less in another direction is noise of a stick, more is another motion
ASIDE: Final = "not possible with a differential drive"
MALFORMED: Final = "malformed"
SAME_NAME: Final = "another robot has this name"
_ADVICE: Final = {
    MALFORMED: "twist takes TwistStamped or Twist, heading Vector3Stamped, arm Header, bumper and cliff Bool, as CDR",
    SAME_NAME: "change bus.robot of one of them",
    "wrong frame": "give base_link for twist, odom for heading, or none",
    "unknown topic": "see controller.sources.names",
}
_MAX_TOPIC: Final = 60  # characters of a topic in the log


def _refused(reason: str) -> Refused:
    return Refused(reason, f"{reason}; {_ADVICE[reason]}" if reason in _ADVICE else "")


class CommandMessage(NamedTuple):
    """A decoded command and the time it was sent, by the sender's clock [ns of Unix time]; 0: it does not say it."""

    stamp_ns: int
    setpoint: Setpoint


def twist_command(payload: bytes) -> CommandMessage:
    """Decode a speed and a yaw rate. Raise OmnidError for anything else."""
    stamp_ns, frame, velocity_mps, yaw_rate_radps, aside = twist_from_cdr(payload)
    _check_frame(frame, "base_link")
    setpoint = Setpoint(_within(velocity_mps, MAX_SPEED_MPS), None, _within(yaw_rate_radps, MAX_YAW_RATE_RADPS))
    for name, speed in zip(ASIDE_NAMES, aside, strict=True):
        if not abs(speed) <= LEAST_SPEED:
            raise Refused(ASIDE, f"twist.{name} = {speed:g} is {ASIDE}; send linear.x and angular.z only")
    return CommandMessage(stamp_ns, setpoint)


def heading_command(payload: bytes) -> CommandMessage:
    """Decode a speed and a heading in odom. Raise OmnidError for anything else."""
    stamp_ns, frame, velocity_mps, heading_rad = heading_from_cdr(payload)
    _check_frame(frame, "odom")
    setpoint = Setpoint(_within(velocity_mps, MAX_SPEED_MPS), _within(heading_rad, MAX_HEADING_RAD))
    return CommandMessage(stamp_ns, setpoint)


def _within(value: float, limit: float) -> float:
    if not math.isfinite(value):
        raise _refused("not finite")
    if abs(value) > limit:
        raise _refused("out of range")
    return value


def _check_frame(frame: str, expected: str) -> None:
    if frame not in ("", expected):
        raise _refused("wrong frame")


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


class _Stream(NamedTuple):
    """Setpoints of one sender on one source: the first one begins a motion, the others go on with it."""

    sender: str
    arrival_ns: int  # of the newest


class CommandReceiver:
    """Passes valid commands on and counts the others by reason; called from threads of the bus.

    Stops are always obeyed. The controller decides which of several sources and senders drives.
    """

    def __init__(
        self,
        target: CommandTarget,
        freshness: Freshness,
        *,
        sources: Sequence[str] = (OPERATOR, PLANNER),
        report: Callable[[str], None] | None = None,
        is_unique: Callable[[], bool] = lambda: True,
    ) -> None:
        """freshness: the rule for the times of sending.

        sources: names; the first has the short topics cmd/twist and cmd/heading, too. report: takes lines for the log,
        one for each refusal. is_unique: False while another robot has this one's name, which is then not armed.
        """
        self._report, self._is_unique = report, is_unique
        self._target, self._freshness = target, freshness
        self._stop_ns = 0  # arrival of the newest stop
        # What is done with each message but a stop, given its time of arrival.
        self._actions: dict[str, Callable[[Request, int], None]] = {
            ARM: self._arm,
            topics.BUMPER: partial(self._touch, BUMPER),
            topics.CLIFF: partial(self._touch, CLIFF),
        }
        parsers = {TWIST: twist_command, HEADING: heading_command}
        for topic, (source, kind) in setpoint_topics(sources).items():
            self._actions[topic] = partial(self._drive, source, parsers[kind])
        self._streams: dict[str, _Stream] = {}  # by source; none after a stop
        self.accepted = self.stops = self.arms = 0
        self.refused: Counter[str] = Counter()
        self.refusal = ""  # the newest one, in words
        self._touched_ns: dict[str, int] = {}  # when the newest contact was sent, by topic

    def receive(self, request: Request) -> Answer | None:
        """Handle one message, never raises; return the refusal, None where there is none or the target decides."""
        arrival_ns = time.monotonic_ns()  # before anything else: a stop that arrives meanwhile voids the command
        if request.topic == STOP:
            self._stop_ns = arrival_ns
            self._streams.clear()
            self.stops += 1
            self._target.stop()
            return None
        try:
            if request.topic not in self._actions:
                raise _refused("unknown topic")
            self._actions[request.topic](request, arrival_ns)
        except Refused as refusal:
            return self._refuse(request.topic, refusal)
        except OmnidError:
            return self._refuse(request.topic, _refused(MALFORMED))
        return None

    def _refuse(self, topic: str, refusal: Refused) -> Answer:
        """Count and report a refusal."""
        self.refused[refusal.reason] += 1
        self.refusal = f"a command on {ascii(topic)[1:-1][:_MAX_TOPIC]} is refused: {refusal}"
        if self._report is not None:
            self._report(self.refusal)
        return Answer(False, str(refusal))

    def _touch(self, contact: str, request: Request, arrival_ns: int) -> None:
        """Pass the state of a contact on.

        A contact ends only by a Bool of False that was sent just now, and not before that of the contact, because
        messages may overtake each other. All other messages are a contact.
        """
        holds = True
        try:
            _check_length(request.payload)
            newest_ns = self._touched_ns.get(request.topic, 0)
            if bool_from_cdr(request.payload):
                sent_ns = self._freshness.sent_ns(request, arrival_ns) or 0
                self._touched_ns[request.topic] = max(newest_ns, min(sent_ns, arrival_ns))
            else:
                holds = self._freshness.require(request, arrival_ns) < newest_ns
        finally:
            self._target.touch(contact, holds=holds)

    def _arm(self, request: Request, arrival_ns: int) -> None:
        _check_length(request.payload)
        sent_ns = self._freshness.require(request, arrival_ns, stamp_from_cdr(request.payload))
        if not self._is_unique():
            raise _refused(SAME_NAME)
        if sent_ns <= self._stop_ns:
            raise _refused(OLDER_THAN_STOP)
        self._streams.clear()
        self.arms += 1
        self._target.arm(ArmRequest(arrival_ns, request.id))

    def _drive(self, source: str, parser: Callable[[bytes], CommandMessage], request: Request, arrival_ns: int) -> None:
        _check_length(request.payload)
        command, stream = parser(request.payload), self._streams.get(source)
        goes_on = (
            stream is not None
            and stream.sender == request.sender
            and self._freshness.goes_on(stream.arrival_ns, arrival_ns)
        )
        judge = self._freshness.of_stream if goes_on else self._freshness.require
        age_ns = max(0, arrival_ns - judge(request, arrival_ns, command.stamp_ns))
        self._streams[source] = _Stream(request.sender, arrival_ns)
        self.accepted += 1
        self._target.send_setpoint(TimedSetpoint(arrival_ns, command.setpoint, source, request.sender, age_ns))


def _check_length(payload: bytes) -> None:
    if len(payload) > LONGEST_PAYLOAD:
        raise _refused("too long")


class SensorReceiver:
    """Passes valid samples on and counts the others; called from threads of the bus, never raises."""

    def __init__(
        self,
        target: Callable[[MotionSample], None],
        stamp_ns: Callable[[int], int],
        topics: frozenset[str],
        report: Callable[[str], None],
        joints: JointWheels | None = None,
    ) -> None:
        """target: may be called from any thread. stamp_ns: returns the stamp, as those of images, of a Unix time.

        topics: those that are used. report: takes a line for the log, once for each topic. joints: the wheels.
        """
        self._joints = joints
        self._target, self._stamp_ns, self._topics, self._report = target, stamp_ns, topics, report
        self.refused: Counter[str] = Counter()  # by topic

    def receive(self, key: str, payload: bytes) -> None:
        """Handle one message."""
        try:
            if key not in self._topics:
                raise OmnidError("it is not used: see motion.wheels, motion.wheel_joints and motion.imu")
            if len(payload) > LONGEST_SAMPLE:
                raise OmnidError(f"it has {len(payload)} bytes, more than {LONGEST_SAMPLE}")
            sample = sample_from_cdr(payload, SENSOR_TOPICS[key], self._stamp_ns, self._joints)
        except OmnidError as error:
            self.refused[key] += 1
            if self.refused[key] == 1:
                self._report(f"a message on {key} is refused: {error}; more of them are counted in the status")
            return
        if sample is not None:
            self._target(sample)
