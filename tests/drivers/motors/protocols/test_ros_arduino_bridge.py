"""ROSArduinoBridge: ticks per period of its loop, counts that overflow, a watchdog with a fixed time."""

from __future__ import annotations

import math

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.ros_arduino_bridge import RosArduinoBridge
from tests.drivers.motors.transactions import UnfinishedError, result, written

DRIVE = DifferentialDrive(track_m=0.5, wheel_radius_m=0.5 / math.pi, ticks_per_turn=4000.0)  # 4000 ticks a metre
TURN = VelocityCommand(0, 0.5, 0.0, 1.0)


def test_bytes() -> None:
    assert written(RosArduinoBridge(DRIVE).drive(TURN, 0.0)) == b"m 33 99\re\r"
    assert written(RosArduinoBridge(DRIVE).connect(2000)) == b"r\re\r"


def test_velocity_is_the_mean_since_the_last_command() -> None:
    protocol = RosArduinoBridge(DRIVE)
    assert math.isnan(result(protocol.drive(TURN, 5.0), b"OK", b"100 100").velocity_mps)
    status = result(protocol.drive(TURN, 5.1), b"OK", b"200 400")
    assert (status.velocity_mps, status.yaw_rate_radps) == pytest.approx((0.5, 1.0))
    assert math.isnan(status.battery_v) and status.fault == 0
    assert math.isnan(result(protocol.drive(TURN, 5.1), b"OK", b"200 400").velocity_mps), "no time has passed"


def test_counts_may_overflow() -> None:
    protocol = RosArduinoBridge(DRIVE)
    result(protocol.drive(TURN, 0.0), b"OK", b"2147483600 -2147483600")
    status = result(protocol.drive(TURN, 0.1), b"OK", b"-2147483496 2147483496")
    assert (status.velocity_mps, status.yaw_rate_radps) == pytest.approx((0.0, -2.0))


def test_ignores_counts_before_the_confirmation() -> None:
    protocol = RosArduinoBridge(DRIVE)
    with pytest.raises(UnfinishedError):
        result(protocol.drive(TURN, 0.0), b"7 7", b"OK", b"Invalid Command", b"1 2 3", b"x y")
    assert protocol.bad_frames == 3


def test_refuses_a_watchdog_shorter_than_the_boards() -> None:
    with pytest.raises(DriverError, match="500 ms requested, 2000 ms is compiled"):
        next(RosArduinoBridge(DRIVE).connect(500))
    assert result(RosArduinoBridge(DRIVE).connect(3000), b"OK", b"0 0") == 2000


def test_limits_ticks_to_the_boards_int() -> None:
    fast = DifferentialDrive(ticks_per_turn=1e6, max_wheel_mps=20.0)
    assert written(RosArduinoBridge(fast).drive(VelocityCommand(0, 20.0, 0.0, 0.0), 0.0)) == b"m 32767 32767\re\r"
