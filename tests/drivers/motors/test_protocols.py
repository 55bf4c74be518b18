"""Protocols of controllers: bytes of their manuals, units of the base, replies that are missing, damaged or wrong."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints

import pytest

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, stop_command
from drivers.motors import serial_motor
from drivers.motors.protocols.line_protocol import LineProtocol, crc16, decode
from drivers.motors.protocols.motor_protocol import DifferentialDrive, MotorProtocol, T, Transaction
from drivers.motors.protocols.odrive_ascii import ODriveAscii, with_checksum
from drivers.motors.protocols.roboteq import Roboteq
from drivers.motors.protocols.vesc import MASK, MAX_ERPM, Vesc, packet
from drivers.motors.serial_motor import GROUP, motor_protocol

# 10 turns of a motor a metre: 600 rpm, or 4,200 electrical ones, at 1 m/s.
DRIVE = DifferentialDrive(track_m=0.5, wheel_radius_m=0.5 / math.pi, gear=10.0, max_wheel_mps=2.0, can_id=9)
TURN = VelocityCommand(0, 0.5, 0.0, 1.0)  # 0.25 and 0.75 m/s
STOP = stop_command(0)


class UnfinishedError(Exception):
    """The transaction waits for more frames."""


def result(transaction: Transaction[T], *frames: bytes) -> T:
    """Return the result of a transaction that receives the frames; raise UnfinishedError if it waits for more."""
    next(transaction)
    try:
        for frame in frames:
            transaction.send(frame)
    except StopIteration as done:
        return done.value  # type: ignore[no-any-return]
    raise UnfinishedError


def lines(*answers: str) -> list[bytes]:
    """Return answers of an ODrive."""
    return [with_checksum(answer).rstrip() for answer in answers]


def values(can_id: int, erpm: int, *, fault: int = 0, status: bytes = b"\0", mask: int = MASK) -> bytes:
    """Return the state of a VESC."""
    return struct.pack(">BIihBB", 50, mask, erpm, 240, fault, can_id) + status


def config(can_id: int, timeout_ms: int) -> bytes:
    """Return the configuration of a VESC."""
    return struct.pack(">BIBI", 17, 0xDEADBEEF, can_id, timeout_ms) + bytes(400)


def armed() -> ODriveAscii:
    protocol = ODriveAscii(DRIVE)
    result(protocol.connect(500), *lines(*["1", "0.500000", "0"] * 2))
    result(protocol.drive(STOP), *lines("0 0", "0 0", "0", "0", "24.0"))
    return protocol


ASKED = bytes.fromhex("32") + MASK.to_bytes(4, "big")
ODRIVE_LINES = ["v 0 2.50000", "v 1 7.50000", "f 0", "f 1", "r axis0.error", "r axis1.error", "r vbus_voltage"]
VESC_PAYLOADS = [ASKED, b"\x22\x09" + ASKED, bytes.fromhex("08 0000041a"), b"\x22\x09" + bytes.fromhex("08 00000c4e")]
# Protocol, bytes of the command TURN, and the replies to it.
CONTROLLERS: dict[str, tuple[Callable[[], MotorProtocol], bytes, list[bytes]]] = {
    "roboteq": (
        lambda: Roboteq(DRIVE),
        b"!S 1 150\r!S 2 450\r?S\r?V 2\r?FF\r",
        [b"+", b"+", b"S=150:450", b"V=240", b"FF=0"],
    ),
    "odrive": (armed, b"".join(map(with_checksum, ODRIVE_LINES)), lines("9.5 2.5", "-7.25 7.5", "0", "0", "24.0")),
    "vesc": (lambda: Vesc(DRIVE), b"".join(map(packet, VESC_PAYLOADS)), [values(3, 1050), values(9, 3150)]),
}


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_command_has_the_bytes_of_the_manual_and_a_status_the_units_of_the_base(name: str) -> None:
    make, sent, replies = CONTROLLERS[name]
    assert next(make().drive(TURN)) == sent
    status = result(make().drive(TURN), *replies)
    assert (status.velocity_mps, status.yaw_rate_radps) == pytest.approx((0.5, 1.0)) and math.isnan(status.heading_rad)
    assert (status.battery_v, status.fault, status.watchdog_expired) == (24.0, 0, False)
    for missing in range(len(replies)):
        with pytest.raises(UnfinishedError):
            result(make().drive(TURN), *replies[:missing], *replies[missing + 1 :])


def test_a_name_leads_to_a_protocol_of_omnid_or_of_an_installed_package(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = EntryPoints(
        [
            EntryPoint("another", "drivers.motors.protocols.line_protocol:LineProtocol", GROUP),
            EntryPoint("missing", "no_such_package:Protocol", GROUP),
        ]
    )
    monkeypatch.setattr(serial_motor, "entry_points", lambda group: installed.select(group=group))
    assert motor_protocol("line") is LineProtocol and motor_protocol("another") is LineProtocol
    with pytest.raises(DriverError, match="expected one of line, roboteq, odrive_ascii, vesc, another, missing;"):
        motor_protocol("waveshare_json")
    with pytest.raises(DriverError, match="its package cannot be loaded"):
        motor_protocol("missing")


# The line protocol


def line(body: bytes) -> bytes:
    return b"$%b*%04X\n" % (body, crc16(body))


def test_the_lines_have_the_documented_bytes() -> None:
    protocol = LineProtocol(DRIVE)
    assert next(protocol.connect(500)) == line(b"W,500")
    drive = protocol.drive(VelocityCommand(99, 0.3, -1.571, 0.0504))
    assert next(drive) == b"$V,0,300,-1571,50*" + b"%04X\n" % crc16(b"V,0,300,-1571,50")
    assert crc16(b"123456789") == 0x29B1


@pytest.mark.parametrize(
    ("contact", "bumper", "cliff"), [(b"", False, False), (b",2", False, True), (b",1", True, False)]
)
def test_a_status_has_seven_numbers_and_the_contacts_where_the_firmware_has_them(
    contact: bytes, bumper: bool, cliff: bool
) -> None:
    status = result(LineProtocol(DRIVE).drive(STOP), line(b"S,0,250,-1500,125,12600,7,1" + contact))
    assert status == MotorStatus(0.25, -1.5, 0.125, True, 7, 12.6, bumper, cliff)


@pytest.mark.parametrize(
    "body",
    [b"", b"S", b"S,", b"S,0,0,0,0,0,0", b"S,0,0,0,0,0,0,0,0,0", b"S,+0,0,0,0,0,0,0", b"S, 0,0,0,0,0,0,0", b"Q,1",
     b"S,1,0,0,0,0,0,0", b"S,0,10001,0,0,0,0,0", b"S,0,0,3143,0,0,0,0", b"S,0,0,0,20001,0,0,0", b"S,0,0,0,0,0,0,2",
     b"S,0000000,0,0,0,0,0,0", "S,\u0660,0,0,0,0,0,0".encode(), b"A,500", b"S,0,0,0,0,0,0,0,4"],
)  # fmt: skip
def test_no_other_line_is_taken_for_the_answer(body: bytes) -> None:
    with pytest.raises(UnfinishedError):
        result(LineProtocol(DRIVE).drive(STOP), line(body))


def test_every_changed_byte_is_detected() -> None:
    whole = line(b"S,0,250,-1500,125,12600,7,1")
    for i in range(len(whole) - 1):
        for value in set(range(256)) - {whole[i], whole[i] ^ 0x20}:  # hexadecimal digits may be small letters
            assert decode(whole[:i] + bytes([value]) + whole[i + 1 :]) is None


def test_a_command_beyond_the_range_of_its_line_is_refused() -> None:
    with pytest.raises(DriverError, match="velocity 12000 is outside"):
        next(LineProtocol(replace(DRIVE, max_wheel_mps=20.0)).drive(VelocityCommand(0, 12.0, 0.0, 0.0)))


# Roboteq


@pytest.mark.parametrize(
    ("in_force", "mixing", "message"),
    [(b"500", b"0", ""), (b"0", b"0", "500 ms requested, 0 ms in force"), (b"500", b"1", "switch mixing off")],
)
def test_roboteq_reads_back_its_watchdog_and_must_not_mix(in_force: bytes, mixing: bytes, message: str) -> None:
    assert next(Roboteq(DRIVE).connect(500)) == b"^ECHOF 1\r^RWD 500\r~RWD\r~MXMD\r"
    replies = b"+", b"+", b"RWD=" + in_force, b"MXMD=" + mixing
    if not message:
        assert result(Roboteq(DRIVE).connect(500), *replies) == 500
        return
    with pytest.raises(DriverError, match=message):
        result(Roboteq(DRIVE).connect(500), *replies)


def test_roboteq_limits_speeds_to_the_range_of_the_manual() -> None:
    fast = DifferentialDrive(wheel_radius_m=0.001, gear=100.0, max_wheel_mps=20.0)
    sent = next(Roboteq(fast).drive(VelocityCommand(0, 20.0, 0.0, 0.0)))
    assert sent.startswith(b"!S 1 65535\r!S 2 65535\r")


# ODrive


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        (("True", "0.5", "0", "true", "0.5", "2048"), ""),
        (("1", "0.5", "0", "0", "0.5", "0"), "500 ms requested, 0 ms in force"),
        (("1", "0.4", "0", "1", "0.5", "0"), "500 ms requested, 400 ms in force"),
        (("1", "0.5", "64", "1", "0.5", "64"), "error 0x40"),
        (("invalid property",), "invalid property"),
    ],
)
def test_odrive_sets_feeds_and_reads_back_its_watchdogs(answers: tuple[str, ...], message: str) -> None:
    sent = next(ODriveAscii(DRIVE).connect(500))
    order = (b"axis1.config.watchdog_timeout 0.5", b"u 1", b"axis1.config.enable_watchdog 1")
    assert sorted(order, key=sent.index) == list(order)
    if not message:
        assert result(ODriveAscii(DRIVE).connect(500), *lines(*answers)) == 500
        return
    with pytest.raises(DriverError, match=message):
        result(ODriveAscii(DRIVE).connect(500), *lines(*answers))


def test_odrive_never_clears_other_errors() -> None:
    protocol = armed()
    status = result(protocol.drive(TURN), *lines("0 0", "0 0", "64", "0", "24"))
    assert status.fault == 64 and not status.watchdog_expired
    assert b"error 0" not in next(protocol.drive(STOP))
    assert result(armed().drive(TURN), *lines("0 0", "0 0", "1", "2048", "24")).fault == 1


def test_only_a_stop_arms_an_expired_axis_of_an_odrive() -> None:
    protocol = armed()
    status = result(protocol.drive(TURN), *lines("0 0", "0 0", "0", "2048", "24"))
    assert status.watchdog_expired and status.fault == 0
    assert b"requested_state" not in next(protocol.drive(TURN))
    sent = next(protocol.drive(STOP))
    for axis in (0, 1):
        order = (b"v %d 0.00000" % axis, b"w axis%d.error 0" % axis, b"w axis%d.requested_state 8" % axis)
        assert sorted(order, key=sent.index) == list(order), "the stop comes before the axis is armed"
        assert b"w axis%d.controller.config.control_mode 2*" % axis in sent, "velocity control"
    assert not result(protocol.drive(STOP), *lines("0 0", "0 0", "0", "0", "24")).watchdog_expired


# VESC


def test_vesc_packets_are_those_of_the_firmware() -> None:
    assert packet(b"\x00") == bytes.fromhex("02 01 00 00 00 03")  # COMM_FW_VERSION
    assert packet(b"\x04") == bytes.fromhex("02 01 04 40 84 03")  # COMM_GET_VALUES
    assert packet(bytes(256))[:3] == b"\x03\x01\x00"


def test_vesc_a_speed_beyond_the_largest_number_is_limited_and_goes_the_same_way() -> None:
    commands = next(Vesc(replace(DRIVE, max_wheel_mps=1e9)).drive(VelocityCommand(0, 1e7, 0.0, 2e7)))
    slow, limited = (b"\x08" + erpm.to_bytes(4, "big") for erpm in (MAX_ERPM // 3, MAX_ERPM))
    assert commands.endswith(packet(slow) + packet(b"\x22\x09" + limited))


def test_vesc_replies_come_in_any_order_with_fault_and_timeout_of_either() -> None:
    swapped = result(Vesc(DRIVE).drive(TURN), values(9, 3150), values(3, 1050))
    assert swapped.yaw_rate_radps == pytest.approx(1.0)
    status = result(Vesc(DRIVE).drive(TURN), values(3, 0), values(9, 0, fault=4, status=b"\x01"))
    assert status.fault == 4 and status.watchdog_expired
    assert not result(Vesc(DRIVE).drive(TURN), values(3, 0, status=b""), values(9, 0, status=b"")).watchdog_expired
    with pytest.raises(UnfinishedError):
        result(Vesc(DRIVE).drive(TURN), values(3, 0), values(3, 0), values(3, 0))


@pytest.mark.parametrize("other", [b"\x32" + config(9, 100)[1:], config(9, 100)[:9], b"\x11"])
def test_vesc_takes_no_other_and_no_cut_payload_for_a_timeout(other: bytes) -> None:
    """The watchdog in force decides when the wheels stop by themselves."""
    protocol = Vesc(DRIVE)
    assert result(protocol.connect(500), config(3, 450), other, config(9, 400)) == 400


@pytest.mark.parametrize("timeout_ms", [0, 501, 1000])
def test_vesc_refuses_a_timeout_that_is_off_or_longer(timeout_ms: int) -> None:
    with pytest.raises(DriverError, match=f"500 ms requested, {timeout_ms} ms in force in the VESC with id 9"):
        result(Vesc(DRIVE).connect(500), config(3, 500), config(9, timeout_ms))
    assert result(Vesc(DRIVE).connect(500), config(9, 500), config(3, 400)) == 400
