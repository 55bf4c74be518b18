"""What may command, by tables: commands, requests to the navigation, samples of wheels and gyro."""

from __future__ import annotations

import logging
import math
import random
import re
import struct
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from drivers.motion import GyroSample, MotionSample, WheelSample
from omnid.controller.link import ControllerStatistics
from omnid.core.control.arming import OLDER_THAN_STOP, ArmRequest, TimedSetpoint
from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.safety_rules import BUMPER, CLIFF
from omnid.core.navigation.requests import GoalRequest, NavigationCommand
from omnid.engine.graph import StageStats, Stream
from omnid.engine.logging_setup import LOGGER
from omnid.engine.robot_clock import RobotClock
from omnid.transport import codec
from omnid.transport.codec import BOOL_SCHEMA, encoded, goal_cdr, path_cdr, string_cdr
from omnid.transport.commands import CommandReceiver, Freshness
from omnid.transport.sensor_codec import gyro_cdr, wheel_cdr
from omnid.transport.topics import IMU, SENSOR_TOPICS, WHEEL_ODOM, Answer, Request
from tests.omnid.transport.bus_fixtures import damaged
from tests.set_clock import SetClock

STALE_S = 0.5
STORE: Any = get_typestore(Stores.ROS2_HUMBLE)
OFFSET_NS = 10**18


WHEELS, GYRO = WheelSample(5 * 10**9, 0.25, -0.5), GyroSample(6 * 10**9, 0.125, -0.25, 0.5, of_base=True)


def logged(lines: list[str]) -> list[str]:
    """Add the lines of the log from now on to a list, which is returned."""
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())  # type: ignore[method-assign]
    LOGGER.addHandler(handler)
    return lines


# Commands.


class AcceptedCommands:
    """Collects the commands that were accepted."""

    def __init__(self, *clocks: RobotClock) -> None:
        self.setpoints: list[Setpoint] = []
        self.arrivals_ns: list[int] = []
        self.stops = 0
        self.arms: list[ArmRequest] = []
        self.contacts: list[tuple[str, bool]] = []
        self.commands: list[TimedSetpoint] = []
        self.lines = logged([])
        self.freshness, self.is_unique = Freshness(STALE_S, *clocks), True
        controller: Any = self
        self.receiver = CommandReceiver(self.freshness, controller=controller)
        self.counts = self.receiver.wheels

    def receive(self, *message: Any, **more: Any) -> Answer | None:
        """Have a message handled; return the answer."""
        return self.receiver.receive(Request(*message, **more, has_namesake=not self.is_unique))

    def send(self, given: TimedSetpoint | ArmRequest) -> None:
        """Keep a setpoint or a request to arm."""
        if isinstance(given, ArmRequest):
            self.arms.append(given)
            return
        self.commands.append(given)
        self.setpoints.append(given.setpoint)
        self.arrivals_ns.append(given.arrival_ns)

    def stop(self) -> None:
        """Count a stop."""
        self.stops += 1

    def touch(self, contact: str, *, holds: bool) -> None:
        """Keep a contact."""
        self.contacts.append((contact, holds))


@pytest.fixture
def accepted() -> AcceptedCommands:
    return AcceptedCommands()


def now_ns(later_s: float = 0.0) -> int:
    return time.time_ns() + round(later_s * 1e9)


def twist(velocity_mps: float = 0.3, rate_radps: float = -0.2, frame: str = "base_link", later_s: float = 0.0) -> bytes:
    return codec.twist_stamped_cdr(now_ns(later_s), frame, velocity_mps, rate_radps)


def plain_twist(velocity_mps: float = 0.3, rate_radps: float = -0.2) -> bytes:
    types = STORE.types
    vectors = [types["geometry_msgs/msg/Vector3"](*v) for v in ((velocity_mps, 0.0, 0.0), (0.0, 0.0, rate_radps))]
    return bytes(STORE.serialize_cdr(types["geometry_msgs/msg/Twist"](*vectors), "geometry_msgs/msg/Twist"))


def heading(velocity_mps: float = 0.4, heading_rad: float = 1.5) -> bytes:
    return codec.encoded(codec.VECTOR_SCHEMA, (now_ns(), "odom"), (velocity_mps, 0.0, heading_rad))


def arm(later_s: float = 0.0) -> bytes:
    return codec.header_cdr(now_ns(later_s))


def bool_cdr(value: bool) -> bytes:
    return encoded(BOOL_SCHEMA, value)


def stamped(stamp: bytes) -> bytes:
    return twist()[:4] + stamp + twist()[12:]


def test_valid_commands_are_accepted(accepted: AcceptedCommands) -> None:
    before_ns = time.monotonic_ns()
    accepted.receive("cmd/twist", twist())
    accepted.receive("cmd/heading", heading())
    accepted.receive("cmd/twist", twist(frame=""))
    accepted.receive("cmd/twist", plain_twist(), sent_ns=now_ns())
    moving = Setpoint(0.3, None, -0.2)
    assert accepted.setpoints == [moving, Setpoint(0.4, 1.5), moving, moving]
    assert before_ns <= accepted.arrivals_ns[0] <= accepted.arrivals_ns[1] <= time.monotonic_ns()
    assert accepted.counts.accepted == 4 and accepted.counts.refused == {}


def aside(name: str, speed: float, *, is_stamped: bool = True) -> bytes:
    """Return a Twist with a speed in a direction that the base has not."""
    types: Any = STORE.types
    vector, stamp = types["geometry_msgs/msg/Vector3"], types["builtin_interfaces/msg/Time"](*divmod(now_ns(), 10**9))
    part, axis = name.split(".")
    parts = {"linear": vector(0.3, 0.0, 0.0), "angular": vector(0.0, 0.0, -0.2)}
    setattr(parts[part], axis, speed)
    message = types["geometry_msgs/msg/Twist"](**parts)
    if is_stamped:
        message = types["geometry_msgs/msg/TwistStamped"](types["std_msgs/msg/Header"](stamp, "base_link"), message)
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


@pytest.mark.parametrize(("name", "is_stamped"), [("linear.y", True), ("angular.x", False)])
def test_a_motion_that_the_base_cannot_make_is_named_and_not_made_in_part(name: str, is_stamped: bool) -> None:
    accepted = AcceptedCommands()
    for speed, expected in ((0.3, "0.3"), (-1e9, "-1e+09"), (math.nan, "nan")):
        answer = accepted.receive("cmd/twist", aside(name, speed, is_stamped=is_stamped), sent_ns=now_ns())
        assert answer is not None and f"differential drive: twist.{name} = {expected};" in answer.text
        assert answer.text in accepted.lines[-1] == accepted.counts.refusal
    assert accepted.receive("cmd/twist", aside(name, 1e-4, is_stamped=is_stamped), sent_ns=now_ns()) is None
    assert accepted.setpoints == [Setpoint(0.3, None, -0.2)] and accepted.counts.refused.total() == 3


NOT_FINITE = [(lambda value=value: twist(velocity_mps=value)) for value in (math.nan, math.inf, -math.inf)]
FAR = [(lambda value=value: twist(rate_radps=value)) for value in (1e300, -1e9, 1001.0)]
EARLY = [(lambda later_s=later_s: twist(later_s=later_s)) for later_s in (5.0, 60.0, 86400.0)]
OLD = [(lambda later_s=later_s: twist(later_s=later_s)) for later_s in (-0.6, -30.0, -59.0, -66.0, -1e8)]


@pytest.mark.hazard("H06")
@pytest.mark.parametrize(
    ("reason", "topic", "makes"),
    [
        ("not finite", "cmd/twist", NOT_FINITE),
        ("not finite", "cmd/heading", [lambda: heading(math.nan, 0.0), lambda: heading(0.1, math.inf)]),
        ("not finite", "cmd/twist", [lambda: twist(rate_radps=math.nan)]),
        ("out of range", "cmd/twist", [*FAR, lambda: twist(velocity_mps=1e9)]),
        ("out of range", "cmd/heading", [lambda: heading(0.1, 1001.0)]),
        ("wrong frame", "cmd/twist", [lambda: twist(frame="odom"), lambda: twist(frame="map" * 100)]),
        ("too old", "cmd/twist", [*OLD, lambda: stamped(struct.pack("<iI", -(2**31), 2**32 - 1))]),
        ("too old", "cmd/twist", [lambda: stamped(b"\xff" * 8)]),
        ("stamp in the future", "cmd/twist", EARLY),
        ("no stamp", "cmd/twist", [lambda: stamped(bytes(8)), plain_twist]),
        ("too long", "cmd/twist", [lambda: twist() + bytes(4096)]),
        ("malformed", "cmd/twist", [lambda: b"{}", lambda: b""]),
        ("not available", "cmd/autopilot/twist", [twist]),
        ("not available", "cmd/planner/stop", [twist]),
        ("malformed", "cmd/arm", [lambda: b"", lambda: b"\xff" * 40]),
        ("too old", "cmd/arm", [lambda: arm(-1.0)]),
        ("stamp in the future", "cmd/arm", [lambda: arm(5.0)]),
        ("no stamp", "cmd/arm", [lambda: codec.header_cdr(0)]),
        ("too long", "cmd/arm", [lambda: bytes(4097)]),
    ],
)
def test_all_other_commands_are_refused_and_counted(
    accepted: AcceptedCommands, reason: str, topic: str, makes: list[Callable[[], bytes]]
) -> None:
    for make in makes:
        answer = accepted.receive(topic, make(), id=7)
        words = "are not a" if reason == "malformed" else reason
        assert answer is None or (not answer.done and words in answer.text)
    assert accepted.counts.refused == {reason: len(makes)}
    assert not accepted.setpoints and not accepted.arms and not accepted.stops


def test_a_stop_may_have_any_payload(accepted: AcceptedCommands) -> None:
    for payload in (b"", b"\xff" * 100_000, twist()):
        accepted.receive("cmd/stop", payload)
    assert accepted.stops == accepted.receiver.stops == 3 and accepted.setpoints == []


def echo(accepted: AcceptedCommands, later_s: float = 0.0) -> int:
    """Return the robot's own time as a sender repeats it."""
    return int(accepted.freshness.own_time()) + round(later_s * 1e9)


HOURS = pytest.mark.parametrize("wrong_s", [3 * 3600.0, -55 * 365.25 * 86400.0])


@pytest.mark.hazard("H06")
@HOURS
def test_a_sender_with_a_wrong_clock_drives_by_the_echo_or_is_told_why_not(
    accepted: AcceptedCommands, wrong_s: float
) -> None:
    """The robot's own time, or the stamp of its newest pose, is as good as a right clock."""
    for topic, payload in (("cmd/arm", arm(wrong_s)), ("cmd/twist", twist(later_s=wrong_s))):
        answer = accepted.receive(topic, payload, sent_ns=now_ns(wrong_s))
        assert answer is not None and "synchronise the clocks" in answer.text and "\n" not in answer.text
        assert re.search(r"\d{5,}\.\d{3} s by the robot's clock", answer.text)
        assert accepted.receive(topic, payload, sent_ns=now_ns(wrong_s), echo_ns=echo(accepted)) is None
        assert accepted.receive(topic, payload, sent_ns=now_ns(wrong_s), echo_ns=echo(accepted, -60.0)) is not None
    assert len(accepted.arms) == 1 and len(accepted.setpoints) == 1
    assert accepted.counts.refused.total() == 4


@pytest.mark.hazard("H06")
def test_an_echo_of_another_run_is_none() -> None:
    """A recording of this very second of another run."""
    before, accepted = AcceptedCommands(), AcceptedCommands()
    answer = accepted.receive("cmd/twist", plain_twist(), echo_ns=echo(before))
    assert answer is not None and not accepted.setpoints


@pytest.mark.hazard("H06")
def test_the_first_setpoint_of_a_stream_says_when_it_was_sent_and_later_ones_need_not(
    accepted: AcceptedCommands,
) -> None:
    assert accepted.receive("cmd/twist", plain_twist(), "pad") is not None, "no stamp"
    assert accepted.receive("cmd/twist", twist(), "pad") is None
    assert accepted.receive("cmd/twist", plain_twist(), "pad") is None, "it goes on"
    assert accepted.receive("cmd/twist", plain_twist(), "stranger") is not None, "of another sender"
    assert accepted.receive("cmd/planner/twist", plain_twist(), "pad") is not None, "of another source"
    assert accepted.receive("cmd/twist", twist(later_s=-0.6), "pad") is not None, "old by its stamp"
    assert accepted.receive("cmd/twist", twist(later_s=3600.0), "pad") is None, "as old as its arrival, at least"
    for ends in ("cmd/stop", "cmd/arm"):
        accepted.receive(ends, arm() if ends == "cmd/arm" else b"")
        assert accepted.receive("cmd/twist", plain_twist(), "pad") is not None, f"the first one after {ends}"
        assert accepted.receive("cmd/twist", twist(), "pad") is None
    assert [command.age_ns for command in accepted.commands] == [pytest.approx(0, abs=2e8)] * len(accepted.commands)


def test_a_setpoint_is_as_old_as_it_says(accepted: AcceptedCommands) -> None:
    accepted.receive("cmd/twist", twist(later_s=-0.3))
    accepted.receive("cmd/twist", twist(later_s=0.2))
    assert 0.3e9 <= accepted.commands[0].age_ns < 0.5e9 and accepted.commands[1].age_ns == 0


@pytest.mark.hazard("H06")
@pytest.mark.parametrize("step_s", [-2.0, 0.1, 3 * 3600.0])
def test_a_step_of_the_robots_clock_makes_no_command_older_or_newer(step_s: float) -> None:
    """Streams go on, with stamps of this computer, or by the echo; what is recorded stays old."""
    computer = SetClock(now_ns() - time.monotonic_ns())
    clock = RobotClock(time.monotonic_ns, lambda: time.monotonic_ns() + computer.offset_ns)
    accepted = AcceptedCommands(clock)

    def stamped_now(age_s: float = 0.0) -> bytes:
        at_ns = time.monotonic_ns() - round(age_s * 1e9) + computer.offset_ns
        return codec.twist_stamped_cdr(at_ns, "base_link", 0.3, 0.0)

    wrong_ns = computer.offset_ns
    assert accepted.receive("cmd/twist", stamped_now(), "pad") is None
    under_way = stamped_now(0.05)
    recorded = stamped_now(30.0)
    clock.follow()
    computer.set_forwards(step_s)
    clock.follow()
    assert accepted.receive("cmd/twist", under_way, "pad") is None
    assert accepted.receive("cmd/twist", stamped_now(), "pad") is None
    assert accepted.receive("cmd/arm", codec.header_cdr(time.monotonic_ns() + computer.offset_ns)) is None
    assert accepted.receive("cmd/twist", recorded, "pad") is not None
    assert accepted.receive("cmd/twist", stamped_now(30.0), "pad") is not None
    assert all(command.age_ns < 0.5e9 for command in accepted.commands)
    # A sender whose clock was not set: by the echo it begins, by its stamp only where that is near.
    old = codec.twist_stamped_cdr(time.monotonic_ns() + wrong_ns, "base_link", 0.3, 0.0)
    assert accepted.receive("cmd/twist", old, "laptop", 0, 1, echo(accepted)) is None
    other = AcceptedCommands(clock)
    assert (other.receive("cmd/twist", old, "laptop") is None) == (abs(step_s) < STALE_S)
    accepted.receive("cmd/stop", old)
    assert accepted.stops == 1


def worse(rng: random.Random, good: bytes) -> bytes:
    """Return a payload with random damage, or numbers that are none."""
    data = bytearray(good)
    match rng.randrange(4):
        case 0:
            return rng.randbytes(rng.randrange(120))
        case 1:
            data[12:16] = struct.pack("<I", rng.randrange(2**32))  # length of the frame's name
        case 2:
            data[-48:] = struct.pack("<6d", *(rng.choice((math.nan, math.inf, 1e308, 1e-320)) for _ in range(6)))
        case _:
            return damaged(rng, good)
    return bytes(data)


@pytest.mark.hazard("H09")
def test_a_thousand_damaged_payloads_are_counted(accepted: AcceptedCommands) -> None:
    """None raises, each is counted, and numbers of payloads that are still valid are finite and in range."""
    rng = random.Random(1)
    for _ in range(1000):
        key, good = rng.choice((("cmd/twist", twist()), ("cmd/heading", heading(0.1, 0.2))))
        accepted.receive(key, worse(rng, good))
    refused = accepted.counts.refused
    assert accepted.counts.accepted + sum(refused.values()) == 1000 and accepted.counts.accepted < 300
    assert len(refused) <= 7 and refused["malformed"] > 400 and refused["not finite"] > 50
    for setpoint in accepted.setpoints:
        assert max(map(abs, (setpoint.velocity_mps, setpoint.yaw_rate_radps, setpoint.heading_rad or 0.0))) <= 100


@pytest.mark.hazard("H48")
def test_a_robot_is_not_armed_beside_one_of_the_same_name() -> None:
    accepted = AcceptedCommands()
    accepted.is_unique = False
    accepted.receive("cmd/arm", arm())
    assert accepted.arms == [] and accepted.counts.refused == {"another robot has this name": 1}
    accepted.is_unique = True
    accepted.receive("cmd/arm", arm())
    assert len(accepted.arms) == 1


@pytest.mark.hazard("H03")
def test_a_request_that_was_sent_before_the_stop_and_comes_after_it_is_refused(accepted: AcceptedCommands) -> None:
    early = arm()
    accepted.receive("cmd/stop", b"")
    accepted.receive("cmd/arm", early)
    assert accepted.arms == [] and accepted.counts.refused == {OLDER_THAN_STOP: 1}
    before_ns = time.monotonic_ns()
    assert accepted.receive("cmd/arm", arm(), id=7) is None, "the controller answers"
    assert accepted.arms[0].id == 7 and before_ns <= accepted.arms[0].arrival_ns <= time.monotonic_ns()
    assert len(accepted.arms) == 1


@pytest.mark.hazard("H08")
@pytest.mark.parametrize(("topic", "contact"), [("cmd/bumper", BUMPER), ("cmd/cliff", CLIFF)])
def test_only_a_false_with_a_fresh_stamp_says_that_a_contact_has_ended(topic: str, contact: str) -> None:
    """A true counts whatever its stamp, and so does what cannot be read: a stop needs no stamp."""
    accepted = AcceptedCommands()
    fresh_ns, old_ns = now_ns(), now_ns(-60.0)
    for payload, sent_ns, expected in (
        (bool_cdr(True), fresh_ns, True),
        (bool_cdr(True), 0, True),
        (bool_cdr(True), old_ns, True),
        (bool_cdr(False), old_ns, True),
        (bool_cdr(False), 0, True),
        (b"off", fresh_ns, True),
        (b"", fresh_ns, True),
        (bytes(5000), fresh_ns, True),
        (bool_cdr(False), fresh_ns, False),
    ):
        accepted.receive(topic, payload, "bumper board", sent_ns)
        assert accepted.contacts.pop() == (contact, expected), payload[:8]
    assert accepted.counts.refused == {"too old": 1, "no stamp": 1, "malformed": 2, "too long": 1}
    assert not accepted.commands and not accepted.arms and not accepted.stops


@pytest.mark.hazard("H08")
@pytest.mark.parametrize("by_echo", [True, False])
def test_an_older_release_that_comes_after_a_contact_does_not_release_it(by_echo: bool) -> None:
    accepted, sent_ns = AcceptedCommands(), now_ns()

    def send(holds: bool, later_s: float) -> None:
        # A board whose clock is wrong by years may say when by the robot's own time.
        stamps = (1, 0, echo(accepted, later_s)) if by_echo else (sent_ns + round(later_s * 1e9), 0, 0)
        accepted.receive("cmd/bumper", bool_cdr(holds), "", *stamps)

    for holds, later_s in ((True, -0.02), (False, -0.2), (False, 0.0)):
        send(holds, later_s)
    assert [holds for _, holds in accepted.contacts] == [True, True, False]
    # A contact that says it comes from the future is a contact, but does not forbid all releases.
    send(True, 1e6)
    sent_ns = now_ns(0.2)
    send(False, 0.2)
    assert [holds for _, holds in accepted.contacts][-2:] == [True, False]


# Requests to the navigation.


class Received:
    """A receiver and what came of it."""

    def __init__(self) -> None:
        self.commands: list[NavigationCommand] = []
        self.lines = logged([])
        self.answer: Answer | None = None  # of the newest message
        self.freshness = Freshness(0.5)
        navigation = Stream[NavigationCommand]()
        controller: Any = SimpleNamespace(statistics=ControllerStatistics(StageStats()))
        navigation.readers.append(cast("Any", self.commands.append))
        self.receiver = CommandReceiver(self.freshness, controller=controller, navigation=navigation)
        self.counts = self.receiver.requests

    def send(self, topic: str, payload: bytes, sent_ns: int = 0, echo_ns: int = 0) -> NavigationCommand | None:
        """Return the command that a message leads to."""
        before = len(self.commands)
        self.answer = self.receiver.receive(Request(f"cmd/{topic}", payload, "", sent_ns, 5, echo_ns))
        return self.commands[-1] if len(self.commands) > before else None


def goal(stamp_ns: int, x: float = 1.5, y: float = -2.0, heading: float | None = 0.5, frame: str = "map") -> bytes:
    return goal_cdr(stamp_ns, frame, (x, y), heading)


@pytest.mark.hazard("H27")
@pytest.mark.parametrize("age_s", [-2.0, 2.0, 3600.0])
def test_a_goal_of_another_time_is_refused_and_a_halt_is_not(age_s: float) -> None:
    received, sent_ns = Received(), time.time_ns() - round(age_s * 1e9)
    assert received.send("goal", goal(sent_ns)) is None
    assert received.send("goal", goal(0)) is None, "it has no stamp"
    assert received.send("route", string_cdr("repeat hall"), sent_ns) is None
    assert received.send("navigation", string_cdr("resume"), sent_ns) is None
    for topic, text in (("navigation", "cancel"), ("navigation", "pause"), ("route", "stop")):
        assert received.send(topic, string_cdr(text), sent_ns) is not None
    assert received.counts.refused.total() == 4 and received.counts.refused["no stamp"] == 1
    assert all("own time" in line or "that of odom" in line for line in received.lines)
    assert not any("\n" in line for line in received.lines)
    assert received.send("goal", goal(sent_ns), 0, int(received.freshness.own_time())) is not None


@pytest.mark.hazard("H27")
@pytest.mark.parametrize(
    ("topic", "text"), [("route", "repeat hall"), ("route", "teach hall"), ("navigation", "resume")]
)
def test_commands_that_begin_a_motion_need_a_stamp_and_those_that_end_one_do_not(topic: str, text: str) -> None:
    received, now_ns = Received(), time.time_ns()
    assert received.send(topic, string_cdr(text)) is None and "no stamp" in received.lines[0]
    assert received.send(topic, string_cdr(f"{text} stamp=0")) is None
    command = received.send(topic, string_cdr(f"{text} stamp={now_ns}"))
    assert command is not None and command.stamp_ns == now_ns
    assert received.send(topic, string_cdr(text), now_ns + 10) is not None
    for end_topic, end in (("navigation", "cancel"), ("navigation", "pause"), ("route", "stop"), ("route", "finish")):
        assert received.send(end_topic, string_cdr(end)) is not None


@pytest.mark.parametrize(
    ("topic", "payload"),
    [
        ("goal", goal_cdr(1, "map", (math.nan, 0.0), 0.0)),
        ("goal", goal_cdr(1, "map", (2e6, 0.0), 0.0)),
        ("goal", goal_cdr(1, "base_link", (1.0, 0.0), 0.0)),
        ("goal", b"\0" * 4097),
        ("path", b"\0" * ((1 << 20) + 1)),
        ("path", path_cdr(1, "map", [[0.0, 0.0], [0.0, math.nan]])),
        ("navigation", string_cdr("dance")),
        ("route", string_cdr("teach ../../etc/passwd")),
    ],
)
def test_malformed_requests_are_refused(topic: str, payload: bytes) -> None:
    received = Received()
    assert received.send(topic, payload) is None
    assert received.answer is not None and not received.answer.done and received.answer.text in received.lines[0]
    assert received.counts.refused.total() == 1 and len(received.lines) == 1


@pytest.mark.hazard("H33")
def test_damaged_messages_never_raise_and_lead_to_finite_goals() -> None:
    rng, received = random.Random(4), Received()
    good = {
        "goal": goal(1),
        "path": path_cdr(1, "map", [[0, 0], [1, 0], [2, 1]]),
        "route": string_cdr("repeat a"),
        "navigation": string_cdr("cancel"),
    }
    for _ in range(2000):
        topic = rng.choice(list(good))
        received.send(topic, damaged(rng, good[topic]))
    for command in received.commands:
        if isinstance(command.request, GoalRequest):
            assert abs(command.request.x_m) <= 1e6 and abs(command.request.y_m) <= 1e6
    assert received.counts.refused.total() + received.counts.accepted == 2000


# Samples of wheels and gyro.


def receiver(taken: list[MotionSample], lines: list[str], *sensors: str) -> CommandReceiver:
    logged(lines)
    samples = Stream[MotionSample]()
    samples.readers.append(cast("Any", taken.append))
    clock = SetClock(OFFSET_NS).clock()
    return CommandReceiver(Freshness(STALE_S, clock), samples=dict.fromkeys(sensors or SENSOR_TOPICS, samples))


def test_samples_arrive_in_the_time_of_the_images() -> None:
    taken, lines = list[MotionSample](), list[str]()
    sensors = receiver(taken, lines)
    sensors.receive(Request(WHEEL_ODOM, wheel_cdr(WHEELS, WHEELS.stamp_ns + OFFSET_NS)))
    sensors.receive(Request(IMU, gyro_cdr(GYRO, GYRO.stamp_ns + OFFSET_NS)))
    assert taken == [WHEELS, GYRO] and not lines and not sensors.samples.refused


@pytest.mark.hazard("H15")
def test_samples_from_the_network_are_checked() -> None:
    """No stamp, absurd or infinite rates, another source in use, damaged bytes: counted, a line for each new one."""
    taken, lines = list[MotionSample](), list[str]()
    sensors = receiver(taken, lines)
    bad = [
        wheel_cdr(WHEELS, 0),
        wheel_cdr(WheelSample(1, 1000.0, 0.0), OFFSET_NS),
        wheel_cdr(WheelSample(1, np.inf, 0.0), OFFSET_NS),
        wheel_cdr(WheelSample(1, np.nan, 0.0), OFFSET_NS),
        wheel_cdr(WHEELS, OFFSET_NS) + bytes(10_000),
        b"",
    ]
    for payload in bad:
        sensors.receive(Request(WHEEL_ODOM, payload))
    assert taken == [] and sensors.samples.refused.total() == len(bad) >= len(lines)
    only_imu = receiver(taken, lines, IMU)
    only_imu.receive(Request(WHEEL_ODOM, wheel_cdr(WHEELS, OFFSET_NS)))
    assert taken == [] and "motion.wheels" in lines[-1]
