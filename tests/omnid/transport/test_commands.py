"""Commands from the network: valid ones are accepted, all others are refused and counted."""

from __future__ import annotations

import math
import random
import struct
import time
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from omnid.core.control.arming import OLDER_THAN_STOP, ArmRequest
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.contacts import BUMPER, CLIFF
from omnid.core.control.heading_controller import Setpoint
from omnid.transport import codec
from omnid.transport.codec import bool_cdr
from omnid.transport.commands import LONGEST_PAYLOAD, CommandReceiver
from omnid.transport.records import TwistRecord
from omnid.transport.requests import Answer, Request
from omnid.transport.stamps import StampRule

STALE_S = 0.5
STORE: Any = get_typestore(Stores.ROS2_HUMBLE)


class AcceptedCommands:
    """Collects the commands that were accepted."""

    def __init__(self, synchronised: bool = True) -> None:
        self.setpoints: list[Setpoint] = []
        self.arrivals_ns: list[int] = []
        self.stops = 0
        self.arms: list[ArmRequest] = []
        self.contacts: list[tuple[str, bool]] = []
        self.commands: list[TimedSetpoint] = []
        self.receiver = CommandReceiver(self, StampRule(STALE_S, synchronised=synchronised))

    def receive(self, *message: Any, **more: Any) -> Answer | None:
        """Have a message handled; return the answer."""
        return self.receiver.receive(Request(*message, **more))

    def send_setpoint(self, command: TimedSetpoint) -> None:
        """Keep a setpoint."""
        self.commands.append(command)
        self.setpoints.append(command.setpoint)
        self.arrivals_ns.append(command.arrival_ns)

    def stop(self) -> None:
        """Count a stop."""
        self.stops += 1

    def arm(self, request: ArmRequest) -> None:
        """Keep a request."""
        self.arms.append(request)

    def touch(self, contact: str, *, holds: bool) -> None:
        """Keep a contact."""
        self.contacts.append((contact, holds))


def receive(receiver: CommandReceiver, *message: Any) -> Answer | None:
    return receiver.receive(Request(*message))


@pytest.fixture
def accepted() -> AcceptedCommands:
    return AcceptedCommands()


def now_ns(later_s: float = 0.0) -> int:
    return time.time_ns() + round(later_s * 1e9)


def twist(velocity_mps: float = 0.3, rate_radps: float = -0.2, frame: str = "base_link", later_s: float = 0.0) -> bytes:
    return codec.twist_stamped_cdr(now_ns(later_s), frame, velocity_mps, rate_radps)


def test_valid_commands_are_accepted(accepted: AcceptedCommands) -> None:
    before_ns = time.monotonic_ns()
    accepted.receive("cmd/twist", twist())
    accepted.receive("cmd/heading", codec.heading_cdr(now_ns(), 0.4, 1.5))
    assert accepted.setpoints == [Setpoint(0.3, None, -0.2), Setpoint(0.4, 1.5)]
    assert before_ns <= accepted.arrivals_ns[0] <= accepted.arrivals_ns[1] <= time.monotonic_ns()
    assert accepted.receiver.accepted == 2 and accepted.receiver.refused == {}


def test_a_stop_may_have_any_payload(accepted: AcceptedCommands) -> None:
    for payload in (b"", b"\xff" * 100_000, twist()):
        accepted.receive("cmd/stop", payload)
    assert accepted.stops == accepted.receiver.stops == 3 and accepted.setpoints == []


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_refuses_numbers_that_are_not_finite(accepted: AcceptedCommands, value: float) -> None:
    accepted.receive("cmd/twist", twist(velocity_mps=value))
    accepted.receive("cmd/twist", twist(rate_radps=value))
    accepted.receive("cmd/heading", codec.heading_cdr(now_ns(), value, 0.0))
    accepted.receive("cmd/heading", codec.heading_cdr(now_ns(), 0.1, value))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"not finite": 4}


@pytest.mark.parametrize("value", [1e300, -1e9, 1001.0])
def test_refuses_numbers_out_of_range(accepted: AcceptedCommands, value: float) -> None:
    accepted.receive("cmd/twist", twist(velocity_mps=value))
    accepted.receive("cmd/twist", twist(rate_radps=value))
    accepted.receive("cmd/heading", codec.heading_cdr(now_ns(), 0.1, value))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"out of range": 3}


def test_refuses_other_frames_and_accepts_an_empty_one(accepted: AcceptedCommands) -> None:
    accepted.receive("cmd/twist", twist(frame="odom"))
    accepted.receive("cmd/twist", twist(frame="map" * 100))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"wrong frame": 2}
    accepted.receive("cmd/twist", twist(frame=""))
    assert accepted.receiver.accepted == 1


@pytest.mark.parametrize("later_s", [-0.6, -30.0, -59.0, -66.0, -1e8])
def test_refuses_commands_that_are_too_old(accepted: AcceptedCommands, later_s: float) -> None:
    accepted.receive("cmd/twist", twist(later_s=later_s))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"too old": 1}


@pytest.mark.hazard("H06")
@pytest.mark.parametrize("later_s", [5.0, 60.0, 86400.0])
def test_refuses_commands_of_the_future(accepted: AcceptedCommands, later_s: float) -> None:
    accepted.receive("cmd/twist", twist(later_s=later_s))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"stamp in the future": 1}


INVALID_STAMPS = (struct.pack("<iI", 0, 0), struct.pack("<iI", -(2**31), 2**32 - 1), b"\xff" * 8)


def test_refuses_invalid_stamps(accepted: AcceptedCommands) -> None:
    for stamp in INVALID_STAMPS:
        payload = bytearray(twist())
        payload[4:12] = stamp
        accepted.receive("cmd/twist", bytes(payload))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"too old": 2, "no stamp": 1}


def plain_twist(velocity_mps: float = 0.3, rate_radps: float = -0.2) -> bytes:
    types = STORE.types
    vectors = [types["geometry_msgs/msg/Vector3"](*v) for v in ((velocity_mps, 0.0, 0.0), (0.0, 0.0, rate_radps))]
    return bytes(STORE.serialize_cdr(types["geometry_msgs/msg/Twist"](*vectors), "geometry_msgs/msg/Twist"))


def test_a_plain_twist_has_the_stamp_of_its_sending(accepted: AcceptedCommands) -> None:
    accepted.receive("cmd/twist", plain_twist(), sent_ns=now_ns())
    assert accepted.setpoints == [Setpoint(0.3, None, -0.2)]
    accepted.receive("cmd/twist", plain_twist(), sent_ns=now_ns(-1.0))
    accepted.receive("cmd/twist", plain_twist())
    accepted.receive("cmd/twist", plain_twist(math.nan), sent_ns=now_ns())
    assert len(accepted.setpoints) == 1
    assert accepted.receiver.refused == {"too old": 1, "no stamp": 1, "not finite": 1}


def test_a_plain_twist_without_stamp_counts_where_the_clocks_differ() -> None:
    accepted = AcceptedCommands(synchronised=False)
    for _ in range(3):
        accepted.receive("cmd/twist", plain_twist())
    assert accepted.setpoints == [Setpoint(0.3, None, -0.2)] * 3
    for sent_ns in (20, 10):
        accepted.receive("cmd/twist", plain_twist(), sent_ns=sent_ns)
    assert accepted.receiver.refused == {"stamp does not rise": 1}


def test_refusals_are_reported_with_what_to_do() -> None:
    lines: list[str] = []
    receiver = CommandReceiver(AcceptedCommands(), StampRule(STALE_S), report=lines.append)
    receive(receiver, "cmd/twist", plain_twist())
    receive(receiver, "cmd/twist", b"{}")
    receive(receiver, "cmd/" + "\n\x1b[2J" * 50, twist())
    assert lines[0].startswith("a command on cmd/twist is refused: no stamp; fill in the stamp")
    assert 'bus.command_clock = "arrival"' in lines[0]
    assert lines[1].startswith("a command on cmd/twist is refused: malformed; twist takes TwistStamped or Twist")
    assert all(line.isprintable() and len(line) < 200 for line in lines) and len(lines) == 3


def stream(start_ns: int, count: int = 5) -> list[bytes]:
    """Return commands at 20 Hz by a sender's clock."""
    return [codec.twist_stamped_cdr(start_ns + round(i * 5e7), "base_link", 0.3, 0.0) for i in range(count)]


@pytest.mark.hazard("H06")
def test_refuses_a_stream_that_is_replayed_after_66_s(accepted: AcceptedCommands) -> None:
    for payload in stream(now_ns(-66.0)):
        accepted.receive("cmd/twist", payload)
    assert accepted.setpoints == [] and accepted.receiver.refused == {"too old": 5}


@pytest.mark.parametrize("later_s", [-1e9, -3600.0, 3600.0])
def test_takes_commands_of_another_clock_where_it_is_configured(later_s: float) -> None:
    accepted = AcceptedCommands(synchronised=False)
    for payload in stream(now_ns(later_s)):
        accepted.receive("cmd/twist", payload)
    assert accepted.receiver.accepted == 5 and accepted.receiver.refused == {}


@pytest.mark.hazard("H06")
def test_refuses_replayed_and_reordered_commands_of_another_clock() -> None:
    accepted, recorded = AcceptedCommands(synchronised=False), stream(10**12)
    for payload in recorded:
        accepted.receive("cmd/twist", payload)
    accepted.receive("cmd/stop", b"")
    for payload in (*recorded, *reversed(recorded)):
        accepted.receive("cmd/twist", payload)
    assert len(accepted.setpoints) == 5 and accepted.receiver.refused == {"stamp does not rise": 10}
    accepted.receive("cmd/heading", codec.heading_cdr(10**12, 0.4, 1.5))
    accepted.receive("cmd/stop", recorded[0])
    assert len(accepted.setpoints) == 6 and accepted.stops == 2


def test_a_refused_command_does_not_move_the_sequence() -> None:
    accepted = AcceptedCommands(synchronised=False)
    accepted.receive("cmd/twist", codec.twist_stamped_cdr(10**15, "base_link", math.nan, 0.0))
    accepted.receive("cmd/twist", stream(10**12, 1)[0])
    assert accepted.receiver.accepted == 1


def test_refuses_long_payloads_without_decoding_them(accepted: AcceptedCommands) -> None:
    good = twist()
    accepted.receive("cmd/twist", good + bytes(LONGEST_PAYLOAD + 1 - len(good)))
    assert accepted.receiver.refused == {"too long": 1}


def damaged(rng: random.Random, good: bytes) -> bytes:
    """Return a payload with random damage."""
    data = bytearray(good)
    match rng.randrange(5):
        case 0:
            return rng.randbytes(rng.randrange(120))
        case 1:
            return bytes(data[: rng.randrange(len(data))])
        case 2:
            for _ in range(rng.randrange(1, 8)):
                data[rng.randrange(len(data))] = rng.randrange(256)
        case 3:
            data[12:16] = struct.pack("<I", rng.randrange(2**32))  # length of the frame's name
        case _:
            data[-48:] = struct.pack("<6d", *(rng.choice((math.nan, math.inf, 1e308, 1e-320)) for _ in range(6)))
    return bytes(data)


@pytest.mark.hazard("H09")
@pytest.mark.parametrize("seed", range(3))
def test_counts_a_thousand_damaged_payloads(accepted: AcceptedCommands, seed: int) -> None:
    """None raises, each is counted, and numbers of payloads that are still valid are finite and in range."""
    rng = random.Random(seed)
    for _ in range(1000):
        key, good = rng.choice((("cmd/twist", twist()), ("cmd/heading", codec.heading_cdr(now_ns(), 0.1, 0.2))))
        accepted.receive(key, damaged(rng, good))
    refused = accepted.receiver.refused
    assert accepted.receiver.accepted + sum(refused.values()) == 1000 and accepted.receiver.accepted < 300
    assert len(refused) <= 7 and refused["malformed"] > 400 and refused["not finite"] > 50
    for setpoint in accepted.setpoints:
        assert abs(setpoint.velocity_mps) <= 20 and abs(setpoint.yaw_rate_radps) <= 50
        assert setpoint.heading_rad is None or abs(setpoint.heading_rad) <= 1000


def test_refuses_messages_of_another_type(accepted: AcceptedCommands) -> None:
    accepted.receive("cmd/twist", codec.heading_cdr(now_ns(), 0.1, 0.2))
    accepted.receive("cmd/twist", codec.pose_stamped_cdr(now_ns(), np.eye(4)))
    assert accepted.setpoints == [] and sum(accepted.receiver.refused.values()) == 2


def arm(later_s: float = 0.0) -> bytes:
    return codec.header_cdr(now_ns(later_s))


def test_a_request_to_arm_is_validated_like_commands(accepted: AcceptedCommands) -> None:
    before_ns, receiver = time.monotonic_ns(), accepted.receiver
    assert accepted.receive("cmd/arm", arm(), id=7) is None, "the controller answers"
    assert [request.id for request in accepted.arms] == [7]
    assert before_ns <= accepted.arms[0].arrival_ns <= time.monotonic_ns() and receiver.arms == 1
    for bad in (b"", arm(-1.0), arm(5.0), b"\xff" * 40, bytes(LONGEST_PAYLOAD + 1), codec.header_cdr(0)):
        answer = accepted.receive("cmd/arm", bad)
        assert answer is not None and not answer.done and answer.text.partition(";")[0] in receiver.refused
    assert len(accepted.arms) == 1
    assert receiver.refused == {"malformed": 2, "too old": 1, "no stamp": 1, "stamp in the future": 1, "too long": 1}


@pytest.mark.hazard("H48")
def test_is_not_armed_beside_a_robot_of_the_same_name() -> None:
    unique, accepted = [False], AcceptedCommands()
    receiver = CommandReceiver(accepted, StampRule(STALE_S), is_unique=lambda: unique[0])
    receive(receiver, "cmd/arm", arm())
    assert accepted.arms == [] and receiver.refused == {"another robot has this name": 1}
    unique[0] = True
    receive(receiver, "cmd/arm", arm())
    assert len(accepted.arms) == 1


@pytest.mark.hazard("H03")
def test_a_request_that_was_sent_before_the_stop_and_comes_after_it_is_refused(accepted: AcceptedCommands) -> None:
    early = arm()
    accepted.receive("cmd/stop", b"")
    accepted.receive("cmd/arm", early)
    assert accepted.arms == [] and accepted.receiver.refused == {OLDER_THAN_STOP: 1}
    accepted.receive("cmd/arm", arm())
    assert len(accepted.arms) == 1


def test_arming_lets_the_stamps_of_another_clock_begin_again() -> None:
    """A stamp far in the future would lock its topic until the restart."""
    accepted = AcceptedCommands(synchronised=False)
    receiver = accepted.receiver
    receive(receiver, "cmd/twist", codec.twist_stamped_cdr(2**31 * 10**9 - 1, "base_link", 0.3, 0.0))
    for payload in stream(10**12):
        receive(receiver, "cmd/twist", payload)
    assert len(accepted.setpoints) == 1 and receiver.refused == {"stamp does not rise": 5}
    receive(receiver, "cmd/arm", codec.header_cdr(10**12))
    for payload in stream(10**12):
        receive(receiver, "cmd/twist", payload)
    assert len(accepted.setpoints) == 6 and len(accepted.arms) == 1


def test_a_recorded_request_to_arm_of_another_clock_is_refused() -> None:
    accepted = AcceptedCommands(synchronised=False)
    for stamp_ns in (10**15, 10**12, 10**12, 10**15):
        accepted.receive("cmd/arm", codec.header_cdr(stamp_ns), id=stamp_ns)
    assert [request.id for request in accepted.arms] == [10**15, 10**12], "also of a clock that began again"
    assert accepted.receiver.refused == {"stamp was used before": 2}


def test_the_topic_names_the_source(accepted: AcceptedCommands) -> None:
    for key in ("cmd/twist", "cmd/operator/twist", "cmd/planner/twist", "cmd/autopilot/twist", "cmd/planner/stop"):
        accepted.receive(key, twist(), "somebody")
    assert [(command.source, command.sender) for command in accepted.commands] == [
        ("operator", "somebody"),
        ("operator", "somebody"),
        ("planner", "somebody"),
    ]
    assert accepted.receiver.refused == {"unknown topic": 2} and accepted.stops == 0


def test_the_arrival_is_that_of_the_message_not_of_its_decoding(
    accepted: AcceptedCommands, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop that arrives while the command is decoded voids it."""
    decoded_ns: list[int] = []

    def decode(payload: bytes) -> TwistRecord:
        decoded_ns.append(time.monotonic_ns())
        return codec.twist_from_cdr(payload)

    monkeypatch.setattr("omnid.transport.commands.twist_from_cdr", decode)
    accepted.receive("cmd/twist", twist())
    assert accepted.arrivals_ns[0] < decoded_ns[0]


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
    assert accepted.receiver.refused == {"too old": 1, "no stamp": 1, "malformed": 2, "too long": 1}
    assert not accepted.commands and not accepted.arms and not accepted.stops


@pytest.mark.parametrize("synchronised", [True, False])
def test_an_older_release_that_comes_after_a_contact_does_not_release_it(synchronised: bool) -> None:
    accepted, sent_ns = AcceptedCommands(synchronised=synchronised), now_ns()
    for payload, later_ns in ((True, 10_000_000), (False, 0), (False, 20_000_000)):
        accepted.receive("cmd/bumper", bool_cdr(payload), "", sent_ns + later_ns - 30_000_000)
    assert [holds for _, holds in accepted.contacts] == [True, True, False]
    # A contact that says it comes from the future is a contact, but does not forbid all releases.
    accepted.receive("cmd/bumper", bool_cdr(True), "", sent_ns + 10**15)
    accepted.receive("cmd/bumper", bool_cdr(False), "", now_ns())
    assert [holds for _, holds in accepted.contacts][-2:] == [True, not synchronised]


def test_after_an_arming_a_bumper_whose_clock_began_again_may_release() -> None:
    accepted = AcceptedCommands(synchronised=False)
    for payload, sent_ns in ((True, 1000), (False, 1001)):
        accepted.receive("cmd/bumper", bool_cdr(payload), "", sent_ns)
    accepted.receive("cmd/arm", arm())
    assert len(accepted.arms) == 1
    accepted.receive("cmd/bumper", bool_cdr(False), "", 5)
    assert [holds for _, holds in accepted.contacts] == [True, False, False]


@pytest.mark.hazard("H08")
def test_an_old_release_that_is_sent_again_does_not_release_where_clocks_differ() -> None:
    accepted = AcceptedCommands(synchronised=False)
    for payload, sent_ns in ((bool_cdr(False), 10), (bool_cdr(True), 11), (bool_cdr(False), 10)):
        accepted.receive("cmd/bumper", payload, "", sent_ns)
    assert [holds for _, holds in accepted.contacts] == [False, True, True]
