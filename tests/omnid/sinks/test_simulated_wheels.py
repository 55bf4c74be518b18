"""The simulated wheels of a replay turn on the clock of its commands."""

from __future__ import annotations

import pytest

from drivers.motor import VelocityCommand, stop_command
from omnid.controller.motor_settings import MotorSettings
from omnid.sinks.simulated_wheels import SimulatedWheels

START_NS = 10**18
PERIOD_NS = 10**8


def test_the_base_drives_as_long_as_the_stamps_say() -> None:
    wheels = SimulatedWheels(MotorSettings())
    for number in range(50):
        wheels.process(VelocityCommand(START_NS + number * PERIOD_NS, 0.2, 0.0, 0.0))
    assert wheels.base.pose[0] == pytest.approx(49 * 0.1 * 0.2, abs=0.05)
    wheels.process(stop_command(START_NS + 50 * PERIOD_NS))
    wheels.finish()
    assert wheels.counts() == {"commands": 51, "errors": 0, "stops": 1}


def test_a_gap_in_the_log_stops_the_base_and_it_goes_on_afterwards() -> None:
    wheels = SimulatedWheels(MotorSettings())
    for start_ns in (START_NS, START_NS + 3600 * 10**9):
        for number in range(10):
            wheels.process(VelocityCommand(start_ns + number * PERIOD_NS, 0.2, 0.0, 0.0))
    assert wheels.counts()["errors"] == 0 and wheels.base.velocity_mps > 0.1
    assert wheels.base.pose[0] < 1.0, "the base did not drive through the gap"
