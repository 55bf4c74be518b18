"""The line protocol: known lines, limits of all ranges, invalid bytes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.protocols.line_protocol import (
    ProtocolError,
    crc16,
    decode,
    encode,
    status_line,
    status_of,
    velocity_line,
)

STATUS = MotorStatus(0.25, -1.5, 0.125, watchdog_expired=True, fault=7, battery_v=12.6)


def with_checksum(body: bytes) -> bytes:
    return b"$%b*%04X\n" % (body, crc16(body))


def test_known_lines() -> None:
    command = VelocityCommand(99, 0.3, -1.571, 0.0504)
    assert velocity_line(17, command) == b"$V,17,300,-1571,50*D3E4\n"
    assert status_line(17, STATUS) == with_checksum(b"S,17,250,-1500,125,12600,7,1")
    assert encode("W", 500) == with_checksum(b"W,500")


def test_the_contacts_are_an_eighth_number_that_firmware_without_them_leaves_out() -> None:
    assert status_line(17, replace(STATUS, cliff=True)) == with_checksum(b"S,17,250,-1500,125,12600,7,1,2")
    kind, numbers = decode(with_checksum(b"S,17,250,-1500,125,12600,7,1"))
    assert (kind, numbers[0], status_of(numbers)) == ("S", 17, STATUS)
    for wrong in (b"4", b"-1", b"0,0"):
        with pytest.raises(ProtocolError):
            decode(with_checksum(b"S,17,250,-1500,125,12600,7,1," + wrong))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e308, 10.001, -10.001, 20.001, -20.001])
@pytest.mark.parametrize("field", ["velocity_mps", "heading_rad", "yaw_rate_radps"])
def test_refuses_to_encode_numbers_out_of_range(field: str, bad: float) -> None:
    if field == "yaw_rate_radps" and abs(bad) < 20:
        bad *= 3
    numbers = {"velocity_mps": 0.1, "heading_rad": 0.1, "yaw_rate_radps": 0.1, field: bad}
    with pytest.raises(ProtocolError):
        velocity_line(0, VelocityCommand(0, **numbers))


@pytest.mark.parametrize("line", [("V", -1, 0, 0, 0), ("V", 65536, 0, 0, 0), ("W", 0), ("W", 19), ("W", 10_001)])
def test_refuses_to_encode_counts_and_times_out_of_range(line: tuple[str, int]) -> None:
    with pytest.raises(ProtocolError, match="keep it inside"):
        encode(*line)


@pytest.mark.parametrize(
    "body",
    [b"", b"V", b"V,", b"V,1,2,3", b"V,1,2,3,4,5", b"V,+1,2,3,4", b"V,1_0,2,3,4", b"V, 1,2,3,4", b"v,1,2,3,4", b"Q,1",
     b"V,1,10001,0,0", b"V,1,0,3143,0", b"V,1,0,0,20001", b"V,65536,0,0,0", b"V,-1,0,0,0", b"V,1,0.5,0,0", b"W,0",
     b"W,1,2,3,4", b"V,0000001,0,0,0", "V,\u0661,0,0,0".encode(), b"S,1,0,0,0,0,0,2", b"A,10001"],
)  # fmt: skip
def test_refuses_invalid_lines_with_a_valid_checksum(body: bytes) -> None:
    with pytest.raises(ProtocolError):
        decode(with_checksum(body))


def test_detects_every_changed_byte() -> None:
    line = velocity_line(17, VelocityCommand(0, 0.3, -1.571, 0.05))
    for i in range(len(line) - 1):
        for value in set(range(256)) - {line[i], line[i] ^ 0x20}:  # hexadecimal digits may be small letters
            with pytest.raises(ProtocolError):
                decode(line[:i] + bytes([value]) + line[i + 1 :])
