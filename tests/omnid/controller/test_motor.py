"""The motor of the settings: the simulation of its protocol, and settings that cannot work."""

from __future__ import annotations

import contextlib
import time
from contextlib import ExitStack

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from drivers.motors.serial_motor import SerialMotor
from drivers.motors.simulated.simulated_motor import SimulatedMotor
from omnid.controller.motor import open_motor
from omnid.controller.motor_settings import DriveSettings, MotorSettings
from tests.contract.pty_motor import PtyMotor

SLOW_HZ = 1.0  # so that a machine under load has a second to answer


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_simulates_every_protocol(protocol: str) -> None:
    drive = DriveSettings(track_m=0.5, reverse_right=True)
    config = MotorSettings(port="simulated", protocol=protocol, rate_hz=SLOW_HZ, watchdog_ms=5000, drive=drive)
    with ExitStack() as closing:
        driver = open_motor(config, closing)
        assert isinstance(driver, SimulatedMotor)
        driver.send(VelocityCommand(0, 0.4, 0.0, 0.2))
        assert driver.base.errors == 0
        assert driver.base.commanded_mps == pytest.approx([0.35, 0.45], rel=0.02)
    assert driver.base.commanded_mps == [0.0, 0.0], "closing stops the wheels"


def test_a_simulated_base_moves_in_real_time() -> None:
    with ExitStack() as closing:
        driver = open_motor(MotorSettings(port="simulated", rate_hz=SLOW_HZ, watchdog_ms=5000), closing)
        for _ in range(2):
            driver.send(VelocityCommand(0, 0.4, 0.0, 0.0))
            time.sleep(0.2)
        assert driver.send(VelocityCommand(0, 0.4, 0.0, 0.0)).velocity_mps == pytest.approx(0.4)


@pytest.mark.parametrize("port", ["simulated", "/dev/null"])
def test_refuses_a_protocol_that_nobody_has(port: str) -> None:
    with ExitStack() as closing, pytest.raises(DriverError, match=r"motor\.protocol 'waveshare_json'"):
        open_motor(MotorSettings(port=port, protocol="waveshare_json"), closing)


def test_refuses_a_watchdog_of_fewer_than_four_ticks() -> None:
    with ExitStack() as closing, pytest.raises(DriverError, match="give at least 200, 4 ticks"):
        open_motor(MotorSettings(port="simulated", rate_hz=20.0, watchdog_ms=199), closing)


def test_a_missing_answer_leaves_time_in_the_tick() -> None:
    with ExitStack() as closing:
        twin = closing.enter_context(contextlib.closing(PtyMotor()))
        driver = open_motor(MotorSettings(port=twin.port, rate_hz=20.0, watchdog_ms=200), closing)
        assert isinstance(driver, SerialMotor) and driver._timeout_s == pytest.approx(0.8 * 0.05)
