"""VESC: packets, the pair on CAN, and the timeout, which can only be read."""

from __future__ import annotations

import math
import struct

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.vesc import MASK, MAX_ERPM, Vesc, packet
from tests.drivers.motors.transactions import UnfinishedError, result, written

DRIVE = DifferentialDrive(track_m=0.5, wheel_radius_m=0.5 / math.pi, pole_pairs=7, can_id=9)  # 420 erpm at 1 m/s
TURN = VelocityCommand(0, 0.5, 0.0, 1.0)


def values(can_id: int, erpm: int, *, fault: int = 0, status: bytes = b"\x00", mask: int = MASK) -> bytes:
    return struct.pack(">BIihBB", 50, mask, erpm, 245, fault, can_id) + status


def config(can_id: int, timeout_ms: int) -> bytes:
    return struct.pack(">BIBI", 17, 0xDEADBEEF, can_id, timeout_ms) + bytes(400)


def test_packets_as_the_firmware_makes_them() -> None:
    assert packet(b"\x00") == bytes.fromhex("02 01 00 00 00 03")  # COMM_FW_VERSION
    assert packet(b"\x04") == bytes.fromhex("02 01 04 40 84 03")  # COMM_GET_VALUES
    assert packet(bytes(256))[:3] == b"\x03\x01\x00"


def test_bytes_of_a_command() -> None:
    asked = bytes.fromhex("32") + MASK.to_bytes(4, "big")
    speeds = bytes.fromhex("08 00000069"), bytes.fromhex("08 0000013b")  # 105 and 315
    whole = [asked, b"\x22\x09" + asked, speeds[0], b"\x22\x09" + speeds[1]]
    assert written(Vesc(DRIVE).drive(TURN, 0.0)) == b"".join(map(packet, whole))


def test_a_speed_beyond_the_largest_number_is_limited_and_goes_the_same_way() -> None:
    fast = Vesc(DifferentialDrive(track_m=0.5, wheel_radius_m=0.5 / math.pi, max_wheel_mps=1e9, can_id=9))
    commands = written(fast.drive(VelocityCommand(0, 1e7, 0.0, 2e7), 0.0))
    slow, limited = (b"\x08" + erpm.to_bytes(4, "big") for erpm in (MAX_ERPM // 3, MAX_ERPM))
    assert commands.endswith(packet(slow) + packet(b"\x22\x09" + limited))


def test_status_in_the_units_of_the_base_in_any_order_of_replies() -> None:
    for answers in ([values(3, 105), values(9, 315)], [values(9, 315), values(3, 105)]):
        status = result(Vesc(DRIVE).drive(TURN, 0.0), *answers)
        assert (status.velocity_mps, status.yaw_rate_radps) == pytest.approx((0.5, 1.0))
        assert (status.battery_v, status.fault, status.watchdog_expired) == (24.5, 0, False)


def test_fault_and_timeout_of_either() -> None:
    status = result(Vesc(DRIVE).drive(TURN, 0.0), values(3, 0), values(9, 0, fault=4, status=b"\x01"))
    assert status.fault == 4 and status.watchdog_expired
    assert not result(Vesc(DRIVE).drive(TURN, 0.0), values(3, 0, status=b""), values(9, 0, status=b"")).watchdog_expired


@pytest.mark.parametrize("other", [b"\x32" + config(9, 100)[1:], config(9, 100)[:9], b"\x11"])
def test_takes_no_other_and_no_cut_payload_for_a_timeout(other: bytes) -> None:
    """The watchdog in force decides when the wheels stop by themselves."""
    protocol = Vesc(DRIVE)
    assert result(protocol.connect(500), config(3, 450), other, config(9, 400)) == 400 and protocol.bad_frames == 1


def test_waits_for_a_reply_of_each_controller() -> None:
    with pytest.raises(UnfinishedError):
        result(Vesc(DRIVE).drive(TURN, 0.0), values(3, 0), values(3, 0), values(3, 0))


@pytest.mark.parametrize("timeout_ms", [0, 501, 1000])
def test_refuses_a_timeout_that_is_off_or_longer(timeout_ms: int) -> None:
    with pytest.raises(DriverError, match=f"500 ms requested, {timeout_ms} ms in force in the VESC with id 9"):
        result(Vesc(DRIVE).connect(500), config(3, 500), config(9, timeout_ms))
    assert result(Vesc(DRIVE).connect(500), config(9, 500), config(3, 400)) == 400
