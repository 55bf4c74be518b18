"""ODrive: lines with checksums, assignment of replies, and axes that only a stop arms."""

from __future__ import annotations

import math

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand, stop_command
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.odrive_ascii import ODriveAscii, with_checksum
from tests.drivers.motors.transactions import UnfinishedError, result, written

DRIVE = DifferentialDrive(track_m=0.5, wheel_radius_m=0.5 / math.pi, gear=10.0)  # 10 turns of the motor a metre
TURN = VelocityCommand(0, 0.5, 0.0, 1.0)


def replies(*answers: str) -> list[bytes]:
    return [with_checksum(answer).rstrip() for answer in answers]


def connected(*, errors: str = "0") -> ODriveAscii:
    protocol = ODriveAscii(DRIVE)
    result(protocol.connect(500), *replies("1", "0.500000", errors, "1", "0.500000", errors))
    return protocol


def armed() -> ODriveAscii:
    protocol = connected()
    result(protocol.drive(stop_command(0), 0.0), *replies("0 0", "0 0", "0", "0", "24.0"))
    return protocol


def test_bytes_of_a_command() -> None:
    lines = ["v 0 2.50000", "v 1 7.50000", "f 0", "f 1", "r axis0.error", "r axis1.error", "r vbus_voltage"]
    assert written(armed().drive(TURN, 0.0)) == b"".join(map(with_checksum, lines))


def test_status_in_the_units_of_the_base() -> None:
    status = result(armed().drive(TURN, 0.0), *replies("100.5 2.5", "-7.25 7.5", "0", "0", "23.75"))
    assert (status.velocity_mps, status.yaw_rate_radps) == pytest.approx((0.5, 1.0))
    assert (status.battery_v, status.fault, status.watchdog_expired) == (23.75, 0, False)


@pytest.mark.parametrize(
    "answers",
    [("0 0", "0", "0", "24.0"), ("0 0", "0 0", "0", "24.0"), ("0", "0 0", "0 0", "0", "0")],
)
def test_ignores_replies_that_do_not_match(answers: tuple[str, ...]) -> None:
    with pytest.raises(UnfinishedError):
        result(armed().drive(TURN, 0.0), *replies(*answers))


@pytest.mark.parametrize("damaged", [b"0 0", b"0 0*1", b"0 0*", with_checksum("0 nan").rstrip(), b"\xff*255", b"*0"])
def test_counts_damaged_replies(damaged: bytes) -> None:
    protocol = armed()
    with pytest.raises(UnfinishedError):
        result(protocol.drive(TURN, 0.0), damaged)
    assert protocol.bad_frames == 1


def test_sets_feeds_and_reads_back_the_watchdogs() -> None:
    lines = written(ODriveAscii(DRIVE).connect(500))
    assert lines.index(b"axis1.config.watchdog_timeout 0.5") < lines.index(b"u 1") < lines.index(
        b"axis1.config.enable_watchdog 1")  # fmt: skip
    with pytest.raises(DriverError, match="500 ms requested, 0 ms in force"):
        result(ODriveAscii(DRIVE).connect(500), *replies("1", "0.5", "0", "0", "0.5", "0"))
    with pytest.raises(DriverError, match="500 ms requested, 0 ms in force"):
        result(ODriveAscii(DRIVE).connect(500), *replies("True", "0.5", "0", "False", "0.5", "0"))
    with pytest.raises(DriverError, match="500 ms requested, 400 ms in force"):
        result(ODriveAscii(DRIVE).connect(500), *replies("1", "0.4", "0", "1", "0.5", "0"))
    assert result(ODriveAscii(DRIVE).connect(500), *replies("True", "0.5", "0", "true", "0.5", "2048")) == 500


def test_never_clears_other_errors() -> None:
    with pytest.raises(DriverError, match="error 0x40"):
        connected(errors="64")
    protocol = armed()
    status = result(protocol.drive(TURN, 0.0), *replies("0 0", "0 0", "64", "0", "24"))
    assert status.fault == 64 and not status.watchdog_expired
    assert b"error 0" not in written(protocol.drive(stop_command(0), 0.0))
    assert result(armed().drive(TURN, 0.0), *replies("0 0", "0 0", "1", "2048", "24")).fault == 1


def test_only_a_stop_arms_an_expired_axis() -> None:
    protocol = armed()
    expired = replies("0 0", "0 0", "0", "2048", "24")
    status = result(protocol.drive(TURN, 0.0), *expired)
    assert status.watchdog_expired and status.fault == 0
    assert b"requested_state" not in written(protocol.drive(TURN, 0.0))
    lines = written(protocol.drive(stop_command(0), 0.0))
    for axis in (0, 1):
        order = [lines.index(b"v %d 0.00000" % axis), lines.index(b"w axis%d.error 0" % axis),
                 lines.index(b"w axis%d.requested_state 8" % axis)]  # fmt: skip
        assert order == sorted(order), "the stop comes before the axis is armed"
        assert b"w axis%d.controller.config.control_mode 2*" % axis in lines, "velocity control"
    assert not result(protocol.drive(stop_command(0), 0.0), *replies("0 0", "0 0", "0", "0", "24")).watchdog_expired


def test_refuses_another_board() -> None:
    with pytest.raises(DriverError, match="invalid property"):
        result(ODriveAscii(DRIVE).connect(500), *replies("invalid property"))
