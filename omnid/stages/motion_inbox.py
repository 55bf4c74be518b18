"""Samples of wheels and gyro on their way to the next pair."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.motion import GyroSample, MotionSample, WheelSample

MOST_WAITING: Final = 4096  # samples: ten seconds of a gyro of 400 Hz
AHEAD_NS: Final = 5 * 10**9  # a sample that is later than a pair by more has a stamp of another clock


class MotionInbox:
    """A bounded queue that belongs to the pairing; the oldest samples give way.

    `add` may be called from any thread: samples come faster than images, from several sources, and must not replace
    each other, as the messages in a stage's inbox do.
    """

    def __init__(self, R_base_imu: NDArray[np.float64] | None = None) -> None:
        """R_base_imu: rotation (3, 3) from the axes of the gyro to those of the base; None: they are the same."""
        self._R_base_imu = R_base_imu
        self._waiting: deque[MotionSample] = deque(maxlen=MOST_WAITING)
        self.wheels = self.gyro = 0  # samples that have come
        self.dropped = 0  # because none took them, their stamps are far ahead, or their rates are not finite

    def add(self, sample: MotionSample) -> None:
        """Add a sample, unless its rates are not finite, which would make the poses not finite too."""
        rates = (sample.velocity_mps,) if isinstance(sample, WheelSample) else _rates(sample)
        if not all(map(math.isfinite, rates)):
            self.dropped += 1
            return
        if isinstance(sample, WheelSample):
            self.wheels += 1
        else:
            self.gyro += 1
            if self._R_base_imu is not None and not sample.of_base:
                x, y, z = (self._R_base_imu @ _rates(sample)).tolist()
                sample = GyroSample(sample.stamp_ns, x, y, z, of_base=True)
        self.dropped += len(self._waiting) == MOST_WAITING
        self._waiting.append(sample)

    def take(self, stamp_ns: int) -> tuple[MotionSample, ...]:
        """Return the samples up to a stamp and the first ones after it, which end the step there; others wait."""
        waiting = sorted((self._waiting.popleft() for _ in range(len(self._waiting))), key=lambda each: each.stamp_ns)
        sane = [sample for sample in waiting if sample.stamp_ns - stamp_ns <= AHEAD_NS]
        self.dropped += len(waiting) - len(sane)
        due = [sample for sample in sane if sample.stamp_ns <= stamp_ns]
        later = sane[len(due) :]
        self._waiting.extendleft(reversed(later))
        first = {type(sample): sample for sample in reversed(later)}
        return (*due, *(sample for sample in later if sample is first[type(sample)]))


def _rates(sample: GyroSample) -> tuple[float, float, float]:
    return sample.x_radps, sample.y_radps, sample.z_radps
