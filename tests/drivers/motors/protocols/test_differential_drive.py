"""The differential drive: its wiring, and sizes that no base has."""

from __future__ import annotations

import itertools
import math

import pytest

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive


def command(velocity_mps: float, yaw_rate_radps: float) -> VelocityCommand:
    return VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps)


@pytest.mark.parametrize("wiring", list(itertools.product([False, True], repeat=3)))
def test_motion_inverts_the_wiring(wiring: tuple[bool, bool, bool]) -> None:
    reverse_left, reverse_right, swapped = wiring
    drive = DifferentialDrive(reverse_left=reverse_left, reverse_right=reverse_right, swapped=swapped)
    assert drive.motion(*drive.channels(command(0.3, -0.7))) == pytest.approx((0.3, -0.7))


@pytest.mark.parametrize("name", ["track_m", "wheel_radius_m", "max_wheel_mps", "gear", "pole_pairs"])
@pytest.mark.parametrize("bad", [0, -1, math.nan, math.inf])
def test_refuses_invalid_sizes(name: str, bad: float) -> None:
    with pytest.raises(DriverError, match=name):
        DifferentialDrive(**{name: bad})  # type: ignore[arg-type]
