"""Samples of wheels and gyro that follow from true poses, with errors that are chosen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.motion import GyroSample, MotionSample, WheelSample

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorErrors:
    """Errors of wheels and gyro; the noise is that of encoders and of a common MEMS gyro."""

    distance: float = 1.0  # metres of the base per metre of the wheels
    turn: float = 1.0
    wheel_offset_s: float = 0.0  # to be added to the stamps
    gyro_offset_s: float = 0.0
    bias_radps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wheel_sigma: tuple[float, float] = (0.002, 0.004)  # m/s, rad/s of a sample
    gyro_sigma_radps: float = 0.003
    wheel_period_s: float = 0.02
    gyro_period_s: float = 0.01


def motion_samples(
    stamps_ns: NDArray[np.int64], T_odom_base: Array, errors: SensorErrors, seed: int
) -> list[MotionSample]:
    """Return the samples, in the order of their stamps, of a base with poses (N, 4, 4); between them it is steady."""
    rng, times_s = np.random.default_rng(seed), (stamps_ns - stamps_ns[0]) * 1e-9
    twists = se3.log(se3.inverse(T_odom_base[:-1]) @ T_odom_base[1:]) / np.diff(times_s)[:, None]

    def at(period_s: float, offset_s: float) -> Iterator[tuple[int, Array]]:
        for time_s in np.arange(0.0, times_s[-1] + 0.2, period_s):
            step = min(int(np.searchsorted(times_s, time_s, side="right")) - 1, len(twists) - 1)
            yield int(stamps_ns[0]) + round((time_s - offset_s) * 1e9), twists[step]

    found: list[MotionSample] = []
    for stamp_ns, rates in at(errors.wheel_period_s, errors.wheel_offset_s):
        found.append(
            WheelSample(
                stamp_ns,
                rates[0] / errors.distance + rng.normal(0, errors.wheel_sigma[0]),
                rates[5] / errors.turn + rng.normal(0, errors.wheel_sigma[1]),
            )
        )
    for stamp_ns, rates in at(errors.gyro_period_s, errors.gyro_offset_s):
        turn = rates[3:] + errors.bias_radps + rng.normal(0, errors.gyro_sigma_radps, 3)
        found.append(GyroSample(stamp_ns, *turn.tolist(), of_base=True))
    return sorted(found, key=lambda sample: sample.stamp_ns)
