"""Arming: stops and faults keep the wheels stopped until a request to arm that came after them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest

from drivers.motor import is_stop
from omnid.core.control import safety_rules
from omnid.core.control.arming import AUTOMATIC, MANUAL, NO_CONTACT, STARTED
from omnid.core.control.motion_monitor import (
    ADVICE,
    CONFLICTS,
    DISAGREEMENTS,
    NOT_COMMANDED,
    NOT_FOLLOWED,
    NOT_SEEN,
    Conflict,
    MotionSettings,
)
from omnid.core.control.safety_rules import BUMPER, CLIFF, LATCHING
from tests.omnid.controller.bench import LIMITS, SETTINGS, UNATTENDED, Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def driving(bench: Bench) -> Bench:
    bench.drive()
    assert bench.last.velocity_mps == 0.3 and bench.controller.state.armed
    return bench


def expect_stand(bench: Bench, ticks: int = 60) -> None:
    """Expect that poses and commands at every tick move nothing, after the ramp."""
    for tick in range(ticks):
        bench.send_pose()
        bench.send_setpoint()
        bench.tick()
        assert tick < 10 or is_stop(bench.last)


def fail(bench: Bench) -> None:
    bench.wheels.silent = True
    bench.tick()
    bench.wheels.silent = False


def stop_itself(bench: Bench) -> None:
    bench.wheels.expired = True
    bench.tick()
    bench.wheels.expired = False


def report_a_fault(bench: Bench) -> None:
    bench.wheels.fault = 7
    bench.tick()
    bench.wheels.fault = 0


def empty_the_battery(bench: Bench) -> None:
    bench.wheels.battery_v = 10.9
    drive_until_stopped(bench)
    bench.wheels.battery_v = 12.0


def run_away(bench: Bench) -> None:
    bench.wheels.velocity_mps = 2.0
    drive_until_stopped(bench)
    bench.wheels.velocity_mps = None


def differ(bench: Bench, reason: str) -> None:
    bench.send_pose(conflict=Conflict(reason, is_fault=True))
    bench.tick()


def drive_until_stopped(bench: Bench, velocity_mps: float = math.nan, sigma_mps: float = 0.0) -> None:
    """Drive with poses of this velocity until a fault stops the wheels."""
    for _ in range(100):
        bench.send_pose(velocity_mps=velocity_mps, sigma_mps=sigma_mps)
        bench.send_setpoint()
        bench.tick()
        if bench.controller.state.reason:
            return
    raise AssertionError("no fault stops the wheels")


FAULTS: dict[str, Callable[[Bench], None]] = {
    safety_rules.FAILED: fail,
    safety_rules.STOPPED: stop_itself,
    safety_rules.OVERLOADED: lambda bench: bench.tick(late_s=0.26),
    safety_rules.POSE_STALE: lambda bench: (bench.send_pose(age_s=1.0), bench.tick())[0],
    safety_rules.POSE_LOST: lambda bench: (bench.send_pose(state="lost"), bench.tick())[0],
    safety_rules.POSE_RESET: lambda bench: (bench.send_pose(resets=1), bench.tick())[0],
    safety_rules.POSE_UNSURE: lambda bench: drive_until_stopped(bench, sigma_mps=1.0),
    safety_rules.MOTOR_FAULT: report_a_fault,
    safety_rules.BATTERY_EMPTY: empty_the_battery,
    NOT_FOLLOWED: run_away,
    NOT_SEEN: lambda bench: drive_until_stopped(bench, velocity_mps=0.0),
    NOT_COMMANDED: lambda bench: drive_until_stopped(bench, velocity_mps=1.2),
    **{reason: partial(differ, reason=reason) for reason in CONFLICTS},
}


def test_every_fault_of_the_table_is_tested() -> None:
    """Contacts latch, and have a test of their own, as has the time before the first pose and the first answer."""
    begins = {safety_rules.NO_POSE, safety_rules.AWAITED}
    assert set(FAULTS) == set(safety_rules.FAULTS) - LATCHING - begins


@pytest.mark.hazard("H01")
def test_wheels_are_disarmed_at_the_start(bench: Bench) -> None:
    expect_stand(bench)
    assert bench.controller.state.reason == safety_rules.NOT_ARMED
    assert bench.controller.state.disarmed_by == STARTED and bench.controller.state.needs_request
    bench.drive()
    assert bench.last.velocity_mps == 0.3 and bench.controller.state.disarmed_by == ""


@pytest.mark.hazard("H04")
@pytest.mark.parametrize("reason", FAULTS)
def test_a_fault_that_has_passed_keeps_the_wheels_stopped(driving: Bench, reason: str) -> None:
    FAULTS[reason](driving)
    expect_stand(driving)
    state = driving.controller.state
    assert state.stops == {reason: 1} and state.disarmed_by == reason and state.needs_request
    (line,) = [line for line in driving.lines if line.startswith(f"the wheels stop: {reason}")]
    assert (ADVICE in line) == (reason in DISAGREEMENTS) and "stay stopped until cmd/arm (`omnid arm`)" in line
    driving.drive()
    assert driving.last.velocity_mps == 0.3


@pytest.mark.parametrize("reason", FAULTS)
def test_without_an_operator_a_fault_that_has_passed_is_over(reason: str) -> None:
    bench = Bench(UNATTENDED)
    bench.drive()
    FAULTS[reason](bench)
    bench.drive(80)
    assert bench.last.velocity_mps == 0.3 and bench.controller.state.stops == {reason: 1}
    assert not any("cmd/arm" in line for line in bench.lines)


@pytest.mark.hazard("H02")
@pytest.mark.parametrize("settings", ["manual", "automatic"])
def test_a_stop_latches_in_both_modes(settings: str) -> None:
    bench = Bench(UNATTENDED) if settings == "automatic" else Bench()
    bench.drive()
    bench.stop()
    expect_stand(bench)
    assert bench.controller.state.reason == safety_rules.ASKED and bench.controller.state.needs_request
    bench.arm()
    bench.drive()
    assert bench.last.velocity_mps == 0.3


@pytest.mark.hazard("H08")
@pytest.mark.parametrize("contact", [BUMPER, CLIFF])
@pytest.mark.parametrize("wired", ["bus", "motor controller"])
@pytest.mark.parametrize("mode", [MANUAL, AUTOMATIC])
def test_bumper_and_cliff_latch_in_both_modes_and_no_request_is_accepted_while_they_hold(
    contact: str, wired: str, mode: str
) -> None:
    """As a stop that was asked for; poses and commands at every tick release nothing."""
    bench = Bench(UNATTENDED if mode == AUTOMATIC else SETTINGS)
    bench.drive()

    def set_contact(holds: bool) -> None:
        if wired == "bus":
            bench.controller.touch(NO_CONTACT.after(contact, holds=holds))
        elif contact == BUMPER:
            bench.wheels.bumper = holds
        else:
            bench.wheels.cliff = holds

    set_contact(True)
    expect_stand(bench)
    assert bench.controller.state.disarmed_by == contact and bench.controller.state.needs_request
    bench.arm()
    bench.tick()
    assert bench.controller.state.arm_answer.refusal == contact and not bench.controller.state.armed
    set_contact(False)
    expect_stand(bench)
    assert bench.controller.state.disarmed_by == contact
    bench.arm()
    bench.tick()
    bench.drive()
    assert bench.controller.state.armed and not is_stop(bench.last)


@pytest.mark.hazard("H37")
def test_a_doubt_slows_the_base_down_and_says_what_differs_and_by_how_much(driving: Bench) -> None:
    """Half of the limits of speed; with the check of motion off, nothing."""
    doubt = Conflict(CONFLICTS[0], "by 0.5 s")
    for _ in range(20):
        driving.send_pose(conflict=doubt)
        driving.send_setpoint()
        driving.tick()
    assert 0.0 < driving.last.velocity_mps == pytest.approx(0.5 * LIMITS.velocity_mps)
    assert driving.lines[-1] == f"the wheels turn slowly: {doubt.reason} by 0.5 s"
    driving.send_pose(conflict=doubt._replace(is_fault=True))
    driving.tick()
    assert driving.lines[-1].startswith(f"the wheels stop: {doubt.reason} by 0.5 s; {ADVICE}")
    unchecked = Bench(replace(SETTINGS, motion=MotionSettings(check=False)))
    unchecked.drive()
    unchecked.send_pose(conflict=doubt._replace(is_fault=True))
    unchecked.send_setpoint()
    unchecked.tick()
    assert unchecked.controller.state.armed and unchecked.last.velocity_mps == 0.3
