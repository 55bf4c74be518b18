"""Commands from the network: valid ones are accepted, all others are refused and counted."""

from __future__ import annotations

import math
import random
import struct
import time

import numpy as np
import pytest

from omnid.core.control.heading_controller import Setpoint
from omnid.transport import codec
from omnid.transport.commands import LONGEST_PAYLOAD, CommandReceiver

STALE_S = 0.5


class AcceptedCommands:
    """Collects the commands that were accepted."""

    def __init__(self, synchronised: bool = True) -> None:
        self.setpoints: list[Setpoint] = []
        self.arrivals_ns: list[int] = []
        self.stops = 0
        self.receiver = CommandReceiver(self._add, self._stop, STALE_S, synchronised=synchronised)

    def _add(self, setpoint: Setpoint, arrival_ns: int) -> None:
        self.setpoints.append(setpoint)
        self.arrivals_ns.append(arrival_ns)

    def _stop(self) -> None:
        self.stops += 1


@pytest.fixture
def accepted() -> AcceptedCommands:
    return AcceptedCommands()


def now_ns(later_s: float = 0.0) -> int:
    return time.time_ns() + round(later_s * 1e9)


def twist(velocity_mps: float = 0.3, rate_radps: float = -0.2, frame: str = "base_link", later_s: float = 0.0) -> bytes:
    return codec.twist_stamped_cdr(now_ns(later_s), frame, velocity_mps, rate_radps)


def test_valid_commands_are_accepted(accepted: AcceptedCommands) -> None:
    before_ns = time.monotonic_ns()
    accepted.receiver.receive("cmd/twist", twist())
    accepted.receiver.receive("cmd/heading", codec.heading_cdr(now_ns(), 0.4, 1.5))
    assert accepted.setpoints == [Setpoint(0.3, None, -0.2), Setpoint(0.4, 1.5)]
    assert before_ns <= accepted.arrivals_ns[0] <= accepted.arrivals_ns[1] <= time.monotonic_ns()
    assert accepted.receiver.accepted == 2 and accepted.receiver.refused == {}


def test_a_stop_may_have_any_payload(accepted: AcceptedCommands) -> None:
    for payload in (b"", b"\xff" * 100_000, twist()):
        accepted.receiver.receive("cmd/stop", payload)
    assert accepted.stops == accepted.receiver.stops == 3 and accepted.setpoints == []


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_refuses_numbers_that_are_not_finite(accepted: AcceptedCommands, value: float) -> None:
    accepted.receiver.receive("cmd/twist", twist(velocity_mps=value))
    accepted.receiver.receive("cmd/twist", twist(rate_radps=value))
    accepted.receiver.receive("cmd/heading", codec.heading_cdr(now_ns(), value, 0.0))
    accepted.receiver.receive("cmd/heading", codec.heading_cdr(now_ns(), 0.1, value))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"not finite": 4}


@pytest.mark.parametrize("value", [1e300, -1e9, 1001.0])
def test_refuses_numbers_out_of_range(accepted: AcceptedCommands, value: float) -> None:
    accepted.receiver.receive("cmd/twist", twist(velocity_mps=value))
    accepted.receiver.receive("cmd/twist", twist(rate_radps=value))
    accepted.receiver.receive("cmd/heading", codec.heading_cdr(now_ns(), 0.1, value))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"out of range": 3}


def test_refuses_other_frames_and_accepts_an_empty_one(accepted: AcceptedCommands) -> None:
    accepted.receiver.receive("cmd/twist", twist(frame="odom"))
    accepted.receiver.receive("cmd/twist", twist(frame="map" * 100))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"wrong frame": 2}
    accepted.receiver.receive("cmd/twist", twist(frame=""))
    assert accepted.receiver.accepted == 1


@pytest.mark.parametrize("later_s", [-0.6, -30.0, -59.0, -66.0, -1e8])
def test_refuses_commands_that_are_too_old(accepted: AcceptedCommands, later_s: float) -> None:
    accepted.receiver.receive("cmd/twist", twist(later_s=later_s))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"too old": 1}


@pytest.mark.parametrize("later_s", [5.0, 60.0, 86400.0])
def test_refuses_commands_of_the_future(accepted: AcceptedCommands, later_s: float) -> None:
    accepted.receiver.receive("cmd/twist", twist(later_s=later_s))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"stamp in the future": 1}


INVALID_STAMPS = (struct.pack("<iI", 0, 0), struct.pack("<iI", -(2**31), 2**32 - 1), b"\xff" * 8)


def test_refuses_invalid_stamps(accepted: AcceptedCommands) -> None:
    for stamp in INVALID_STAMPS:
        payload = bytearray(twist())
        payload[4:12] = stamp
        accepted.receiver.receive("cmd/twist", bytes(payload))
    assert accepted.setpoints == [] and accepted.receiver.refused == {"too old": 3}


def stream(start_ns: int, count: int = 5) -> list[bytes]:
    """Return commands at 20 Hz by a sender's clock."""
    return [codec.twist_stamped_cdr(start_ns + round(i * 5e7), "base_link", 0.3, 0.0) for i in range(count)]


def test_refuses_a_stream_that_is_replayed_after_66_s(accepted: AcceptedCommands) -> None:
    for payload in stream(now_ns(-66.0)):
        accepted.receiver.receive("cmd/twist", payload)
    assert accepted.setpoints == [] and accepted.receiver.refused == {"too old": 5}


@pytest.mark.parametrize("later_s", [-1e9, -3600.0, 3600.0])
def test_takes_commands_of_another_clock_where_it_is_configured(later_s: float) -> None:
    accepted = AcceptedCommands(synchronised=False)
    for payload in stream(now_ns(later_s)):
        accepted.receiver.receive("cmd/twist", payload)
    assert accepted.receiver.accepted == 5 and accepted.receiver.refused == {}


def test_refuses_replayed_and_reordered_commands_of_another_clock() -> None:
    accepted, recorded = AcceptedCommands(synchronised=False), stream(10**12)
    for payload in recorded:
        accepted.receiver.receive("cmd/twist", payload)
    accepted.receiver.receive("cmd/stop", b"")
    for payload in (*recorded, *reversed(recorded)):
        accepted.receiver.receive("cmd/twist", payload)
    assert len(accepted.setpoints) == 5 and accepted.receiver.refused == {"stamp does not rise": 10}
    accepted.receiver.receive("cmd/heading", codec.heading_cdr(10**12, 0.4, 1.5))
    accepted.receiver.receive("cmd/stop", recorded[0])
    assert len(accepted.setpoints) == 6 and accepted.stops == 2


def test_a_refused_command_does_not_move_the_sequence() -> None:
    accepted = AcceptedCommands(synchronised=False)
    accepted.receiver.receive("cmd/twist", codec.twist_stamped_cdr(10**15, "base_link", math.nan, 0.0))
    accepted.receiver.receive("cmd/twist", stream(10**12, 1)[0])
    assert accepted.receiver.accepted == 1


def test_refuses_long_payloads_without_decoding_them(accepted: AcceptedCommands) -> None:
    good = twist()
    accepted.receiver.receive("cmd/twist", good + bytes(LONGEST_PAYLOAD + 1 - len(good)))
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


@pytest.mark.parametrize("seed", range(3))
def test_counts_a_thousand_damaged_payloads(accepted: AcceptedCommands, seed: int) -> None:
    """None raises, each is counted, and numbers of payloads that are still valid are finite and in range."""
    rng = random.Random(seed)
    for _ in range(1000):
        key, good = rng.choice((("cmd/twist", twist()), ("cmd/heading", codec.heading_cdr(now_ns(), 0.1, 0.2))))
        accepted.receiver.receive(key, damaged(rng, good))
    refused = accepted.receiver.refused
    assert accepted.receiver.accepted + sum(refused.values()) == 1000 and accepted.receiver.accepted < 300
    assert len(refused) <= 7 and refused["malformed"] > 400 and refused["not finite"] > 50
    for setpoint in accepted.setpoints:
        assert abs(setpoint.velocity_mps) <= 20 and abs(setpoint.yaw_rate_radps) <= 50
        assert setpoint.heading_rad is None or abs(setpoint.heading_rad) <= 1000


def test_refuses_messages_of_another_type(accepted: AcceptedCommands) -> None:
    accepted.receiver.receive("cmd/twist", codec.heading_cdr(now_ns(), 0.1, 0.2))
    accepted.receiver.receive("cmd/twist", codec.pose_stamped_cdr(now_ns(), np.eye(4)))
    assert accepted.setpoints == [] and sum(accepted.receiver.refused.values()) == 2
