"""Motion of the base as wheels and gyro measure it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class WheelSample:
    """Velocity of the base by its wheels, on a straight line or an arc."""

    stamp_ns: int  # of the measurement, by the clock of the images' stamps
    velocity_mps: float  # forward
    yaw_rate_radps: float  # counter-clockwise; NaN if unknown


@dataclass(frozen=True, slots=True)
class GyroSample:
    """Angular velocity about the axes of the gyro, or of the base: x forward, y left, z up."""

    stamp_ns: int  # of the measurement, by the clock of the images' stamps
    x_radps: float
    y_radps: float
    z_radps: float
    of_base: bool = False  # the axes are those of the base, however the gyro is mounted


MotionSample: TypeAlias = WheelSample | GyroSample
