"""The differential drive: units, signs, wiring, and limits that keep the curvature."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive


def command(velocity_mps: float, yaw_rate_radps: float) -> VelocityCommand:
    return VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps)


def test_a_left_turn_has_a_faster_right_wheel() -> None:
    drive = DifferentialDrive(track_m=0.4)
    assert drive.channels(command(0.5, 0.0)) == (0.5, 0.5)
    assert drive.channels(command(0.0, 1.0)) == (-0.2, 0.2)
    assert drive.channels(command(0.5, 1.0)) == pytest.approx((0.3, 0.7))


def test_turns_of_the_motor_per_metre() -> None:
    assert DifferentialDrive(wheel_radius_m=0.5 / math.pi, gear=20.0).turns_per_m == pytest.approx(20.0)


@pytest.mark.parametrize("wiring", list(itertools.product([False, True], repeat=3)))
def test_motion_inverts_the_wiring(wiring: tuple[bool, bool, bool]) -> None:
    reverse_left, reverse_right, swapped = wiring
    drive = DifferentialDrive(reverse_left=reverse_left, reverse_right=reverse_right, swapped=swapped)
    assert drive.motion(*drive.channels(command(0.3, -0.7))) == pytest.approx((0.3, -0.7))


def test_wiring_by_name() -> None:
    assert DifferentialDrive(track_m=0.4, swapped=True).channels(command(0.0, 1.0)) == (0.2, -0.2)
    assert DifferentialDrive(track_m=0.4, reverse_left=True).channels(command(0.5, 0.0)) == (-0.5, 0.5)
    assert DifferentialDrive(reverse_right=True, swapped=True).channels(command(0.5, 0.0)) == (-0.5, 0.5)


def test_limits_wheel_speeds_and_keeps_the_curvature() -> None:
    rng, drive = random.Random(2), DifferentialDrive(track_m=0.35, max_wheel_mps=0.8)
    for _ in range(2000):
        wanted = command(rng.gauss(0, 3), rng.gauss(0, 8))
        top_mps = rng.choice([math.inf, 0.5])
        speeds = drive.channels(wanted, top_mps)
        velocity_mps, yaw_rate_radps = drive.motion(*speeds)
        assert max(map(abs, speeds)) <= min(0.8, top_mps) * (1 + 1e-12)
        assert velocity_mps * wanted.yaw_rate_radps == pytest.approx(yaw_rate_radps * wanted.velocity_mps)
        assert velocity_mps * wanted.velocity_mps >= 0.0


def test_does_not_change_commands_within_the_limits() -> None:
    assert DifferentialDrive().limited(command(0.3, 0.2)) == (0.3, 0.2)
    assert DifferentialDrive().limited(command(0.0, 0.0)) == (0.0, 0.0)


@pytest.mark.parametrize("name", ["track_m", "wheel_radius_m", "max_wheel_mps", "gear", "pole_pairs"])
@pytest.mark.parametrize("bad", [0, -1, math.nan, math.inf])
def test_refuses_invalid_sizes(name: str, bad: float) -> None:
    with pytest.raises(DriverError, match=name):
        DifferentialDrive(**{name: bad})  # type: ignore[arg-type]
