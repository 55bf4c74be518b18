"""Waveshare: lines of JSON, the heartbeat, and any JSON as a reply."""

from __future__ import annotations

import math

import pytest

from drivers.motor import VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.waveshare_json import WaveshareJson
from tests.drivers.motors.transactions import UnfinishedError, result, written

DRIVE = DifferentialDrive(track_m=0.5, max_wheel_mps=5.0)
TURN = VelocityCommand(0, 0.5, 0.0, 1.0)


def test_bytes() -> None:
    assert written(WaveshareJson(DRIVE).drive(TURN, 0.0)) == b'{"T":1,"L":0.25,"R":0.75}\n{"T":130}\n'
    quiet = [b'{"T":143,"cmd":0}', b'{"T":131,"cmd":0}', b'{"T":142,"cmd":0}']
    assert written(WaveshareJson(DRIVE).connect(700)).splitlines() == [*quiet, b'{"T":136,"cmd":700}', b'{"T":130}']


def test_limits_speeds_to_two_metres_per_second() -> None:
    fast = VelocityCommand(0, 4.0, 0.0, 0.0)
    assert written(WaveshareJson(DRIVE).drive(fast, 0.0)).startswith(b'{"T":1,"L":2.0,"R":2.0}')


@pytest.mark.parametrize(("voltage", "battery_v"), [(b"12.1", 12.1), (b"1210", 12.1), (b"12", 12.0)])
def test_status_in_the_units_of_the_base(voltage: bytes, battery_v: float) -> None:
    answer = b'{"T":1001,"L":0.25,"R":0.75,"r":0.1,"v":' + voltage + b"}"
    status = result(WaveshareJson(DRIVE).drive(TURN, 0.0), answer)
    assert (status.velocity_mps, status.yaw_rate_radps, status.battery_v) == pytest.approx((0.5, 1.0, battery_v))


def test_a_missing_battery_voltage_is_nan() -> None:
    assert math.isnan(result(WaveshareJson(DRIVE).drive(TURN, 0.0), b'{"T":1001,"L":0,"R":0}').battery_v)


@pytest.mark.parametrize(
    ("frame", "bad"),
    [
        (b'{"T":1002,"L":1,"R":1}', 0),
        (b'{"T":1,"L":0.25,"R":0.75}', 0),
        (b'{"T":1001,"L":NaN,"R":0}', 0),
        (b'{"T":1001,"L":"fast","R":0}', 1),
        (b'{"T":1001,"L":' + b"9" * 400 + b',"R":0}', 1),
        (b'{"T":1001,"R":0}', 1),
        (b'{"T":1001', 1),
        (b"[1001]", 1),
        (b"1001", 1),
        (b"[" * 1000, 1),
        (b"\xff\xfe", 1),
    ],
)
def test_ignores_other_lines(frame: bytes, bad: int) -> None:
    protocol = WaveshareJson(DRIVE)
    with pytest.raises(UnfinishedError):
        result(protocol.drive(TURN, 0.0), frame)
    assert protocol.bad_frames == bad
