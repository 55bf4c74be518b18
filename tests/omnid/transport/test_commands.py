"""Commands from the network: what is obeyed, and how everything else is refused and counted."""

from __future__ import annotations

import math
import random
import struct
import time

import numpy as np
import pytest

from omnid.core.control.heading_controller import Setpoint
from omnid.transport import codec
from omnid.transport.commands import LONGEST_PAYLOAD, Commands

STALE_S = 0.5


class Obeyed:
    """What came through."""

    def __init__(self) -> None:
        self.setpoints: list[Setpoint] = []
        self.arrivals_ns: list[int] = []
        self.stops = 0
        self.commands = Commands(self._obey, self._stop, STALE_S)

    def _obey(self, setpoint: Setpoint, arrival_ns: int) -> None:
        self.setpoints.append(setpoint)
        self.arrivals_ns.append(arrival_ns)

    def _stop(self) -> None:
        self.stops += 1


@pytest.fixture
def obeyed() -> Obeyed:
    return Obeyed()


def now_ns(later_s: float = 0.0) -> int:
    return time.time_ns() + round(later_s * 1e9)


def twist(velocity_mps: float = 0.3, rate_radps: float = -0.2, frame: str = "base_link", later_s: float = 0.0) -> bytes:
    return codec.twist_stamped_cdr(now_ns(later_s), frame, velocity_mps, rate_radps)


def test_good_commands_are_obeyed(obeyed: Obeyed) -> None:
    before_ns = time.monotonic_ns()
    obeyed.commands.take("cmd/twist", twist())
    obeyed.commands.take("cmd/heading", codec.heading_cdr(now_ns(), 0.4, 1.5))
    assert obeyed.setpoints == [Setpoint(0.3, None, -0.2), Setpoint(0.4, 1.5)]
    assert before_ns <= obeyed.arrivals_ns[0] <= obeyed.arrivals_ns[1] <= time.monotonic_ns()
    assert obeyed.commands.accepted == 2 and obeyed.commands.refused == {}


def test_a_stop_is_any_payload_at_all(obeyed: Obeyed) -> None:
    for payload in (b"", b"\xff" * 100_000, twist()):
        obeyed.commands.take("cmd/stop", payload)
    assert obeyed.stops == obeyed.commands.stops == 3 and obeyed.setpoints == []


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused(obeyed: Obeyed, value: float) -> None:
    obeyed.commands.take("cmd/twist", twist(velocity_mps=value))
    obeyed.commands.take("cmd/twist", twist(rate_radps=value))
    obeyed.commands.take("cmd/heading", codec.heading_cdr(now_ns(), value, 0.0))
    obeyed.commands.take("cmd/heading", codec.heading_cdr(now_ns(), 0.1, value))
    assert obeyed.setpoints == [] and obeyed.commands.refused == {"not finite": 4}


@pytest.mark.parametrize("value", [1e300, -1e9, 1001.0])
def test_what_is_absurd_is_refused(obeyed: Obeyed, value: float) -> None:
    obeyed.commands.take("cmd/twist", twist(velocity_mps=value))
    obeyed.commands.take("cmd/twist", twist(rate_radps=value))
    obeyed.commands.take("cmd/heading", codec.heading_cdr(now_ns(), 0.1, value))
    assert obeyed.setpoints == [] and obeyed.commands.refused == {"out of range": 3}


def test_another_frame_is_refused_and_none_is_taken_for_ours(obeyed: Obeyed) -> None:
    obeyed.commands.take("cmd/twist", twist(frame="odom"))
    obeyed.commands.take("cmd/twist", twist(frame="map" * 100))
    assert obeyed.setpoints == [] and obeyed.commands.refused == {"another frame": 2}
    obeyed.commands.take("cmd/twist", twist(frame=""))
    assert obeyed.commands.accepted == 1


@pytest.mark.parametrize("later_s", [-0.6, -30.0, -59.0])
def test_what_was_sent_long_ago_is_refused(obeyed: Obeyed, later_s: float) -> None:
    obeyed.commands.take("cmd/twist", twist(later_s=later_s))
    assert obeyed.setpoints == [] and obeyed.commands.refused == {"sent long ago": 1}


@pytest.mark.parametrize("later_s", [-0.1, 5.0, -61.0, -1e8, 86400.0])
def test_the_stamp_of_another_clock_does_not_count(obeyed: Obeyed, later_s: float) -> None:
    obeyed.commands.take("cmd/twist", twist(later_s=later_s))
    assert obeyed.commands.accepted == 1


def test_senseless_stamps_do_not_count_either(obeyed: Obeyed) -> None:
    for stamp in (struct.pack("<iI", 0, 0), struct.pack("<iI", -(2**31), 2**32 - 1), b"\xff" * 8):
        payload = bytearray(twist())
        payload[4:12] = stamp
        obeyed.commands.take("cmd/twist", bytes(payload))
    assert obeyed.commands.accepted == 3


def test_what_is_too_long_is_not_even_looked_at(obeyed: Obeyed) -> None:
    good = twist()
    obeyed.commands.take("cmd/twist", good + bytes(LONGEST_PAYLOAD + 1 - len(good)))
    assert obeyed.commands.refused == {"too long": 1}


def damaged(rng: random.Random, good: bytes) -> bytes:
    """A payload with something wrong."""
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
            data[12:16] = struct.pack("<I", rng.randrange(2**32))  # how long the frame's name is
        case _:
            data[-48:] = struct.pack("<6d", *(rng.choice((math.nan, math.inf, 1e308, 1e-320)) for _ in range(6)))
    return bytes(data)


@pytest.mark.parametrize("seed", range(3))
def test_a_thousand_malformed_payloads(obeyed: Obeyed, seed: int) -> None:
    """None raises, each is counted, and what damage has left harmless is finite and in range."""
    rng = random.Random(seed)
    for _ in range(1000):
        key, good = rng.choice((("cmd/twist", twist()), ("cmd/heading", codec.heading_cdr(now_ns(), 0.1, 0.2))))
        obeyed.commands.take(key, damaged(rng, good))
    refused = obeyed.commands.refused
    assert obeyed.commands.accepted + sum(refused.values()) == 1000 and obeyed.commands.accepted < 300
    assert len(refused) <= 5 and refused["malformed"] > 400 and refused["not finite"] > 50
    for setpoint in obeyed.setpoints:
        assert abs(setpoint.velocity_mps) <= 20 and abs(setpoint.yaw_rate_radps) <= 50
        assert setpoint.heading_rad is None or abs(setpoint.heading_rad) <= 1000


def test_the_wrong_type_is_refused(obeyed: Obeyed) -> None:
    obeyed.commands.take("cmd/twist", codec.heading_cdr(now_ns(), 0.1, 0.2))
    obeyed.commands.take("cmd/twist", codec.pose_stamped_cdr(now_ns(), np.eye(4)))
    assert obeyed.setpoints == [] and sum(obeyed.commands.refused.values()) == 2
