"""Roboteq: the bytes of the manual, and input that is not accepted as a reply."""

from __future__ import annotations

import math

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.roboteq import Roboteq
from tests.drivers.motors.transactions import UnfinishedError, result, written

DRIVE = DifferentialDrive(track_m=0.5, wheel_radius_m=0.5 / math.pi, gear=10.0, max_wheel_mps=2.0)  # 600 rpm at 1 m/s
TURN = VelocityCommand(0, 0.5, 0.0, 1.0)
ANSWERS = (b"+", b"+", b"S=150:450", b"V=246", b"FF=0")


def test_bytes_of_a_command_and_of_the_setup() -> None:
    assert written(Roboteq(DRIVE).drive(TURN, 0.0)) == b"!S 1 150\r!S 2 450\r?S\r?V 2\r?FF\r"
    assert written(Roboteq(DRIVE).connect(500)) == b"^ECHOF 1\r^RWD 500\r~RWD\r~MXMD\r"


def test_status_in_the_units_of_the_base() -> None:
    status = result(Roboteq(DRIVE).drive(TURN, 0.0), *ANSWERS[:4], b"FF=20")
    assert (status.velocity_mps, status.yaw_rate_radps) == pytest.approx((0.5, 1.0))
    assert (status.battery_v, status.fault) == (24.6, 20) and math.isnan(status.heading_rad)


@pytest.mark.parametrize("missing", range(len(ANSWERS)))
def test_waits_for_every_confirmation_and_every_reply(missing: int) -> None:
    with pytest.raises(UnfinishedError):
        result(Roboteq(DRIVE).drive(TURN, 0.0), *ANSWERS[:missing], *ANSWERS[missing + 1 :])


def test_a_rejection_is_an_error_that_names_the_lines() -> None:
    with pytest.raises(DriverError, match=r"rejected one of !S 1 150"):
        result(Roboteq(DRIVE).drive(TURN, 0.0), b"+", b"-")


def test_reads_back_the_watchdog() -> None:
    assert result(Roboteq(DRIVE).connect(500), b"+", b"+", b"RWD=500", b"MXMD=0") == 500
    with pytest.raises(DriverError, match="500 ms requested, 0 ms in force"):
        result(Roboteq(DRIVE).connect(500), b"+", b"+", b"RWD=0", b"MXMD=0")


def test_a_controller_that_mixes_its_channels_is_refused() -> None:
    with pytest.raises(DriverError, match="switch mixing off"):
        result(Roboteq(DRIVE).connect(500), b"+", b"+", b"RWD=500", b"MXMD=1")


def test_refuses_a_controller_with_one_channel() -> None:
    with pytest.raises(DriverError, match="two"):
        result(Roboteq(DRIVE).drive(TURN, 0.0), b"+", b"+", b"S=150", b"V=246", b"FF=0")


def test_limits_speeds_to_the_range_of_the_manual() -> None:
    fast = DifferentialDrive(wheel_radius_m=0.001, gear=100.0, max_wheel_mps=20.0)
    assert written(Roboteq(fast).drive(VelocityCommand(0, 20.0, 0.0, 0.0), 0.0)).startswith(b"!S 1 65535\r!S 2 65535\r")
