"""Samples of wheels and gyro on their way to the next pair."""

from __future__ import annotations

from collections import deque
from typing import Final

from drivers.motion import GyroSample, MotionSample, WheelSample

MOST_WAITING: Final = 4096  # samples: ten seconds of a gyro of 400 Hz
AHEAD_NS: Final = 10**10  # a sample so far after a pair has a stamp of another clock


class MotionInbox:
    """A bounded queue that belongs to the pairing; the oldest samples give way.

    `add` may be called from any thread: samples come faster than images, from several sources, and must not replace
    each other, as the messages in a stage's inbox do.
    """

    def __init__(self) -> None:
        self._waiting: deque[MotionSample] = deque(maxlen=MOST_WAITING)
        self.wheels = self.gyro = 0  # samples that have come
        self.dropped = 0  # because none took them, or their stamps are far ahead

    def add(self, sample: MotionSample) -> None:
        """Add a sample."""
        if isinstance(sample, WheelSample):
            self.wheels += 1
        else:
            self.gyro += 1
        self.dropped += len(self._waiting) == MOST_WAITING
        self._waiting.append(sample)

    def take(self, stamp_ns: int) -> tuple[MotionSample, ...]:
        """Return the samples up to a stamp and the first ones after it, which end the step there; others wait."""
        waiting = [self._waiting.popleft() for _ in range(len(self._waiting))]
        due = [sample for sample in waiting if sample.stamp_ns <= stamp_ns]
        later = sorted((sample for sample in waiting if sample.stamp_ns > stamp_ns), key=lambda each: each.stamp_ns)
        first = {type(sample): sample for sample in reversed(later)}
        for sample in reversed(later):
            if sample.stamp_ns - stamp_ns > AHEAD_NS:
                self.dropped += 1
            else:
                self._waiting.appendleft(sample)
        due += [first[kind] for kind in (WheelSample, GyroSample) if kind in first]
        return tuple(sorted(due, key=lambda sample: sample.stamp_ns))
