"""What comes from the network, validated: commands and contacts, requests to the navigation, samples.

`topics.COMMANDS` has type and bounds of each topic, `CommandReceiver` its freshness and action.

When was a message sent? One rule (`Freshness`) for all that can begin, resume or release a motion. All times in it are
the robot's CLOCK_MONOTONIC. A message says when it was sent by

    echo   the robot's own time, as the robot sent it to the sender, attached; no other clock is in it
    stamp  Unix time by the sender's clock, in its header or attached; compared with the robot's clocks

and the nearer of the two to its arrival counts. What can begin a motion (arm, a goal, the first setpoint of a stream,
the release of a contact) must say it, and have been sent within stale_s of its arrival: a message that waited in a
network, or was recorded, begins none. What goes on with a motion is as old as it says, and at least as its arrival; it
need not say anything. What ends a motion is accepted in any case.
"""

from __future__ import annotations

import logging
import math
import re
import secrets
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Final, TypeAlias

from drivers.motion import MotionSample
from omnid.controller.link import DriveLink
from omnid.core.control.arming import OLDER_THAN_STOP, OPERATOR, PLANNER, ArmRequest, TimedSetpoint
from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.safety_rules import BUMPER, CLIFF
from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.core.navigation import requests
from omnid.core.navigation.path import FARTHEST_M
from omnid.engine.graph import Stream
from omnid.engine.logging_setup import log
from omnid.engine.robot_clock import RobotClock
from omnid.errors import OmnidError
from omnid.plain_text import plain
from omnid.transport import codec, topics
from omnid.transport.sensor_codec import LARGEST_VALUE, sample_from_cdr
from omnid.transport.topics import Answer, Request

MIN_SPEED: Final = 1e-3  # m/s, rad/s; less in another direction is noise of a stick, more is another motion
_CLOCKS: Final = (
    "synchronise the clocks, or stamp with the robot's own time: omnid.client attaches it, another program may repeat "
    "the stamp of the newest odom; controller.deadlines.command_s is the longest age"
)
_NO_MOTOR: Final = "the daemon runs without a motor: set motor.port, or start it with --motor"
_NO_SAMPLES: Final = "it is not used, see motion.wheels and motion.imu"
_NO_MAP_FILE: Final = (
    "the robot keeps no map in a file: start its daemon with --map FILE.omap, or set places.map, "
    "without --localize-only"
)
# What to do where a topic has no action.
WHY_NOT: Final = dict.fromkeys(topics.COMMANDS, _NO_MOTOR) | {
    topics.MAP: _NO_MAP_FILE,
    **dict.fromkeys(topics.SENSOR_TOPICS, _NO_SAMPLES),
}
_STAMPED: Final = re.compile(r"(.*\S)\s+stamp=(\d{1,19})\s*", re.DOTALL)
Action: TypeAlias = Callable[[Request, int], object]  # takes a message and its arrival, ns of CLOCK_MONOTONIC
CONTACTS: Final = {topics.BUMPER: BUMPER, topics.CLIFF: CLIFF}


class Refused(OmnidError):  # noqa: N818 - named after what it reports
    """A message that is not obeyed; reason: in the words that are counted. str() says more, and what to do."""

    def __init__(self, reason: str, found: str = "") -> None:
        """found: what was measured, and the remedy."""
        super().__init__(f"{reason}: {found}" if found else reason)
        self.reason = reason


class Freshness:
    """Judges when messages were sent; arrival_ns is when they came."""

    def __init__(self, stale_s: float, clock: RobotClock | None = None, simulated: RobotClock | None = None) -> None:
        """clock: that of the computer. simulated: that of a simulated robot, of which a stamp may be as well."""
        self.stale_ns = round(stale_s * NS_PER_S)
        self.clock, self._simulated = clock or RobotClock(), simulated
        self._zero_ns = secrets.randbits(61)  # an echo of an earlier run is none of this one

    def own_time(self) -> str:
        """Return the robot's own time for senders, who repeat it as an echo."""
        return str(self.clock.monotonic_ns() + self._zero_ns)

    def sent_ns(self, request: Request, arrival_ns: int, stamp_ns: int = 0) -> int | None:
        """Return when a message was sent; None: it does not say it.

        stamp_ns: in the message; 0: that which is attached counts.
        """
        found_ns = [request.echo_ns - self._zero_ns] if request.echo_ns else []
        if unix_ns := stamp_ns or request.sent_ns:
            found_ns.append(self.clock.stamp_ns(unix_ns))
            if self._simulated is not None:
                found_ns.append(arrival_ns - self._simulated.age_ns(unix_ns))
        return min(found_ns, key=lambda sent_ns: abs(arrival_ns - sent_ns), default=None)

    def require(self, request: Request, arrival_ns: int, stamp_ns: int = 0, *, goes_on: bool = False) -> int:
        """Return when a message was sent. Raise Refused where that was long ago.

        goes_on: it goes on with a motion; else it can begin one, and must say when it was sent.
        """
        sent_ns = self.sent_ns(request, arrival_ns, stamp_ns)
        if goes_on:
            sent_ns = arrival_ns if sent_ns is None else min(arrival_ns, sent_ns)
        if sent_ns is None:
            how = "ROS 2: `header: auto`; String: last word stamp=NANOSECONDS"
            raise Refused("no stamp", f"fill in the stamp ({how}), or repeat that of odom")
        age_ns = arrival_ns - sent_ns
        by_robot = f"{abs(age_ns) * S_PER_NS:.3f} s by the robot's clock"
        if age_ns < -self.stale_ns:
            raise Refused("stamp in the future", f"by {by_robot}; {_CLOCKS}")
        if age_ns > self.stale_ns:
            raise Refused("too old", f"sent before {by_robot}; on a busy computer try again; else {_CLOCKS}")
        return sent_ns


@dataclass(slots=True)
class MessageCounts:
    """Numbers of the messages to one part of the robot."""

    accepted: int = 0
    refused: Counter[str] = field(default_factory=Counter)  # by reason
    refusal: str = ""  # the newest one


class CommandReceiver:
    """Handles each message by the action of its topic, counts and reports those that are refused, and never raises.

    It is called from threads of the bus. Stops are always obeyed. The controller decides which source and sender
    drives. wheels (setpoints), requests, samples: numbers of messages; stops: number of them.
    """

    def __init__(
        self,
        freshness: Freshness,
        *,
        controller: DriveLink | None = None,
        navigation: Stream[requests.NavigationCommand] | None = None,
        saves: Stream[int] | None = None,
        samples: Mapping[str, Stream[MotionSample]] = MappingProxyType({}),
    ) -> None:
        """freshness: the rule for the times of sending.

        controller: None without wheels. navigation: takes requests; None: there is none. saves: takes the ids of
        requests to save the map; None: it is in no file. samples: take those of wheels and gyro, by topic.
        """
        self._freshness, self._samples = freshness, samples
        self.wheels, self.requests, self.samples = MessageCounts(), MessageCounts(), MessageCounts()
        self._counts = dict.fromkeys(topics.NAVIGATION_TOPICS, self.requests)
        self._counts |= dict.fromkeys(topics.SENSOR_TOPICS, self.samples)
        self._actions: dict[str, Action] = {}
        if controller is not None:
            self._controller = controller
            self._actions |= {topics.ARM: self._arm, topics.STOP: self._stop}
            self._actions |= {topic: partial(self._touch, contact) for topic, contact in CONTACTS.items()}
            self._actions |= {
                topics.TWIST: partial(self._drive, OPERATOR, _twist_command),
                topics.HEADING: partial(self._drive, OPERATOR, _heading_command),
                topics.PLANNER_TWIST: partial(self._drive, PLANNER, _twist_command),
                topics.PLANNER_HEADING: partial(self._drive, PLANNER, _heading_command),
            }
        if navigation is not None:
            self._actions |= dict.fromkeys(topics.NAVIGATION_TOPICS, partial(self._ask, navigation))
        if saves is not None:
            self._actions[topics.MAP] = partial(_save, saves)
        self._actions |= dict.fromkeys(samples, self._take_sample)
        self._stop_ns = 0  # arrival of the newest stop
        self._touched_ns = dict.fromkeys(CONTACTS.values(), 0)  # when the newest contact was sent, or arrived before
        # Sender and newest arrival of the setpoints of each source: the first one begins a motion, the others go on
        # with it. There are none after a stop.
        self._streams: dict[str, tuple[str, int]] = {}
        self.stops = 0

    def receive(self, request: Request) -> Answer | None:
        """Handle one message; return the refusal, None where there is none or the target answers."""
        # The arrival is read before anything else: a stop that arrives meanwhile voids a command.
        arrival_ns = self._freshness.clock.monotonic_ns()
        counts = self._counts.get(request.topic, self.wheels)
        try:
            if (action := self._actions.get(request.topic)) is None:
                raise Refused("not available", WHY_NOT.get(request.topic, ""))
            if len(request.payload) > (longest := topics.COMMANDS[request.topic].longest):
                raise Refused("too long", f"{len(request.payload)} bytes, expected at most {longest}")
            action(request, arrival_ns)
        except OmnidError as error:
            if request.topic in CONTACTS and request.topic in self._actions:  # what cannot be read is a contact
                self._controller.touch(CONTACTS[request.topic], holds=True)
            counts.refused[error.reason if isinstance(error, Refused) else "malformed"] += 1
            before, counts.refusal = counts.refusal, f"a message on {plain(request.topic)} is refused: {error}"
            if counts.refusal != before:
                log(logging.WARNING, counts.refusal)
            return Answer(False, str(error))
        return None

    def _stop(self, _: Request, arrival_ns: int) -> None:
        self._stop_ns = arrival_ns
        self._streams.clear()
        self.stops += 1
        self._controller.stop()

    def _touch(self, contact: str, request: Request, arrival_ns: int) -> None:
        """Pass the state of a contact on.

        A contact ends only by a Bool of False that was sent just now, and not before that of the contact, because
        messages may overtake each other. All other messages are a contact.
        """
        holds = bool(codec.decoded(request.payload, codec.BOOL_SCHEMA).data)
        if holds:
            sent_ns = self._freshness.sent_ns(request, arrival_ns) or 0
            self._touched_ns[contact] = max(self._touched_ns[contact], min(sent_ns, arrival_ns))
        else:
            holds = self._freshness.require(request, arrival_ns) < self._touched_ns[contact]
        self._controller.touch(contact, holds=holds)

    def _arm(self, request: Request, arrival_ns: int) -> None:
        stamp_ns = codec.stamp_of(codec.decoded(request.payload, codec.HEADER_SCHEMA))
        sent_ns = self._freshness.require(request, arrival_ns, stamp_ns)
        if request.has_namesake:
            raise Refused("another robot has this name", "change bus.robot of one of them")
        if sent_ns <= self._stop_ns:
            raise Refused(OLDER_THAN_STOP)
        self._streams.clear()
        self._controller.send(ArmRequest(arrival_ns, request.id))

    def _drive(
        self, source: str, parser: Callable[[bytes], tuple[int, Setpoint]], request: Request, arrival_ns: int
    ) -> None:
        stamp_ns, setpoint = parser(request.payload)
        sender, before_ns = self._streams.get(source, ("", -math.inf))
        goes_on = sender == request.sender and arrival_ns - before_ns <= self._freshness.stale_ns
        sent_ns = self._freshness.require(request, arrival_ns, stamp_ns, goes_on=goes_on)
        self._streams[source] = request.sender, arrival_ns
        self.wheels.accepted += 1
        age_ns = max(0, arrival_ns - sent_ns)
        self._controller.send(TimedSetpoint(arrival_ns, setpoint, source, request.sender, age_ns))

    def _ask(self, navigation: Stream[requests.NavigationCommand], message: Request, arrival_ns: int) -> None:
        """Pass on a request to the navigation.

        What ends a motion (cancel, pause, finish, stop) is obeyed whatever its age. All else needs a fresh stamp: a
        request that waited in a network must not start a drive minutes later.
        """
        request, stamp_ns = _navigation_request(message.topic, message.payload)
        if not requests.begins_nothing(request):
            self._freshness.require(message, arrival_ns, stamp_ns)
        self.requests.accepted += 1
        stamp_ns, stops = stamp_ns or message.sent_ns, self._controller.statistics.state.stop_count
        unix_ns = self._freshness.clock.unix_ns(arrival_ns)
        navigation.push(requests.NavigationCommand(request, unix_ns, stamp_ns, message.id, stops))

    def _take_sample(self, request: Request, _: int) -> None:
        schema = topics.COMMANDS[request.topic].schema
        self._samples[request.topic].push(sample_from_cdr(request.payload, schema, self._freshness.clock.stamp_ns))


def _save(saves: Stream[int], request: Request, _: int) -> None:
    if codec.string_from_cdr(request.payload) != topics.SAVE_MAP:
        raise OmnidError(f'a String "{topics.SAVE_MAP}" was expected')
    saves.push(request.id)


def _twist_command(payload: bytes) -> tuple[int, Setpoint]:
    """Return the stamp [ns], 0 without one, of a speed and a yaw rate. Raise OmnidError for anything else."""
    stamp_ns, frame, velocity_mps, yaw_rate_radps, unsupported = codec.twist_from_cdr(payload)
    _check(frame, "base_link", velocity_mps, yaw_rate_radps)
    for name, speed in unsupported.items():
        if not abs(speed) <= MIN_SPEED:
            found = f"twist.{name} = {speed:g}; send linear.x and angular.z only"
            raise Refused("not possible with a differential drive", found)
    return stamp_ns, Setpoint(velocity_mps, None, yaw_rate_radps)


def _heading_command(payload: bytes) -> tuple[int, Setpoint]:
    """Return the stamp [ns] of a speed and a heading in odom. Raise OmnidError for anything else."""
    message = codec.decoded(payload, codec.VECTOR_SCHEMA)
    velocity_mps, heading_rad = message.vector.x, message.vector.z
    _check(message.header.frame_id, "odom", velocity_mps, heading_rad)
    return codec.stamp_of(message.header), Setpoint(velocity_mps, heading_rad)


def _check(frame: str, expected: str, *values: float) -> None:
    """Raise Refused for another frame, or for a number (SI units) of which the sender must have meant another unit."""
    if frame not in ("", expected):
        raise Refused("wrong frame", f"{frame[:40]!a}, expected {expected} or none")
    if not all(map(math.isfinite, values)):
        raise Refused("not finite")
    if any(abs(value) > LARGEST_VALUE for value in values):
        raise Refused("out of range")


def _navigation_request(topic: str, payload: bytes) -> tuple[requests.NavigationRequest, int]:
    """Decode a request and its stamp [ns], 0 where it has none. Raise OmnidError for anything else."""
    if topic in (topics.GOAL, topics.PATH):
        stamp_ns, name, xy, heading_rad = codec.path_from_cdr(payload, schema=topics.COMMANDS[topic].schema)
        if not (abs(xy) <= FARTHEST_M).all():
            raise OmnidError(f"a position beyond {FARTHEST_M:g} m: check the sender")
        if name not in list(requests.NavigationFrame):
            raise OmnidError(f"the frame {name[:40]!a}: expected map or odom")
        frame = requests.NavigationFrame(name)
        if topic == topics.PATH:
            return requests.PathRequest(frame, xy, heading_rad), stamp_ns
        return requests.GoalRequest(frame, float(xy[0, 0]), float(xy[0, 1]), heading_rad), stamp_ns
    text = codec.string_from_cdr(payload)
    stamped = _STAMPED.fullmatch(text)
    text, stamp_ns = (stamped[1], int(stamped[2])) if stamped else (text, 0)
    return (requests.navigation_verb(text) if topic == topics.NAVIGATION else requests.route_request(text)), stamp_ns
