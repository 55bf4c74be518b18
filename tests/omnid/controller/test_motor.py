"""The motor of the settings: the simulation of its protocol, and settings that cannot work."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from omnid.controller.motor import open_motor
from omnid.controller.motor_settings import DriveSettings, MotorSettings

SLOW_HZ = 1.0  # so that a machine under load has a second to answer


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_simulates_every_protocol(protocol: str) -> None:
    drive = DriveSettings(track_m=0.5, reverse_right=True)
    config = MotorSettings(port="simulated", protocol=protocol, rate_hz=SLOW_HZ, watchdog_ms=5000, drive=drive)
    with ExitStack() as closing:
        driver, twin = open_motor(config, closing)
        driver.send(VelocityCommand(0, 0.4, 0.0, 0.2))
        assert twin is not None and twin.base.errors == 0
        assert twin.base.commanded_mps == pytest.approx([0.35, 0.45], rel=0.02)
    assert twin.base.commanded_mps == [0.0, 0.0], "closing stops the wheels"


@pytest.mark.parametrize("port", ["simulated", "/dev/null"])
def test_refuses_a_protocol_that_nobody_has(port: str) -> None:
    with ExitStack() as closing, pytest.raises(DriverError, match=r"motor\.protocol 'waveshare_json'"):
        open_motor(MotorSettings(port=port, protocol="waveshare_json"), closing)


def test_refuses_a_watchdog_of_fewer_than_four_ticks() -> None:
    with ExitStack() as closing, pytest.raises(DriverError, match="give at least 200, 4 ticks"):
        open_motor(MotorSettings(port="simulated", rate_hz=20.0, watchdog_ms=199), closing)


def test_a_missing_answer_leaves_time_in_the_tick() -> None:
    with ExitStack() as closing:
        driver, _ = open_motor(MotorSettings(port="simulated", rate_hz=20.0, watchdog_ms=200), closing)
        assert driver._timeout_s == pytest.approx(0.8 * 0.05)
