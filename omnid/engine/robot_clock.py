"""The time of a robot: CLOCK_MONOTONIC for all stamps inside, and its offset to Unix time, which is followed.

A computer's clock is set while a robot runs: by NTP, by hand, at each boot of a board without a battery. Times inside
omnid do not change by that: durations, ages, rates and deadlines are differences of CLOCK_MONOTONIC. On the bus and in
recordings a stamp s is the Unix time

    unix(s) = s + offset(s)

with the offset that was in force at s, so a stamp has one Unix time in however many messages it is sent. A change of
the offset by more than STEP_NS is a step, which is logged. Smaller changes are followed in silence.
"""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.engine.graph import Lock
from omnid.engine.logging_setup import log

STEP_NS: Final = 1_000_000  # less than two images of a pair are apart, more than NTP slews in a second
KEPT: Final = 64  # offsets that are remembered: without steps, those of a minute at least


class RobotClock:
    """Both clocks of a run; for any thread. steps: number of steps of Unix time so far."""

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = lambda: time.time_ns(),
    ) -> None:
        """monotonic_ns: the clock of the stamps. unix_ns: the clock that may be set."""
        self.monotonic_ns, self._unix_ns = monotonic_ns, unix_ns
        self._following = Lock()
        # Stamps from which on an offset is in force [ns], with the offset.
        self._offsets = deque[tuple[float, int]]([(-math.inf, self._measured()[1])], KEPT)
        self.steps, self._step_at_ns = 0, 0

    def follow(self) -> None:
        """Measure the offset, follow it, and log a step; without a step at most once a second."""
        with self._following:
            error_ns, offset_ns, now_ns = self._measured()
            since_ns, before_ns = self._offsets[-1]
            change_ns = offset_ns - before_ns
            is_step = abs(change_ns) > STEP_NS + error_ns
            if is_step or (abs(change_ns) > error_ns and now_ns - since_ns > NS_PER_S):
                self._offsets.append((now_ns, offset_ns))
            if not is_step:
                return
            self.steps, self._step_at_ns = self.steps + 1, now_ns
        how = f"was set {'forwards' if change_ns > 0 else 'back'} by {abs(change_ns) * S_PER_NS:.3f} s"
        log(logging.WARNING, f"the computer's clock {how}: stamps follow it, a recording goes on in a new file")

    def _measured(self) -> tuple[int, int, int]:
        """Return the largest error of an offset, the offset, and the time of both [ns]; of three the most exact one.

        A reading that is interrupted would move the stamps of a recording against each other.
        """
        readings = []
        for _ in range(3):
            before_ns, unix_ns, after_ns = self.monotonic_ns(), self._unix_ns(), self.monotonic_ns()
            readings.append((after_ns - before_ns, unix_ns - (before_ns + after_ns) // 2, after_ns))
        return min(readings)

    def _offset_ns(self, stamp_ns: int) -> int:
        """Return the offset from a stamp to Unix time, as it was last measured before the stamp."""
        offsets = tuple(self._offsets)
        return next((offset_ns for since_ns, offset_ns in reversed(offsets) if since_ns <= stamp_ns), offsets[0][1])

    def unix_ns(self, stamp_ns: int) -> int:
        """Return the Unix time of a stamp."""
        self.follow()
        return stamp_ns + self._offset_ns(stamp_ns)

    def segment_unix_ns(self, stamp_ns: int) -> int:
        """Return the Unix time in a recording, whose files have no step in them: each step begins a new file.

        A message from before a step that arrives after it has the time of the new file.
        """
        self.follow()
        return stamp_ns + self._offset_ns(max(stamp_ns, self._step_at_ns))

    def stamp_ns(self, unix_ns: int) -> int:
        """Return the stamp of a Unix time: of all that have it, before and after a step, the nearest to now.

        A Unix time that a step has skipped was read from a clock that was not set: the newest offset applies to it.
        """
        self.follow()
        stamps = [unix_ns - offset_ns for _, offset_ns in tuple(self._offsets)]
        in_force = [stamp for stamp in stamps if stamp + self._offset_ns(stamp) == unix_ns]
        now_ns = self.monotonic_ns()
        return min(in_force, key=lambda stamp: abs(now_ns - stamp), default=stamps[-1])

    def age_ns(self, unix_ns: int) -> int:
        """Return the time since a Unix time; below 0 where it is to come."""
        return self.monotonic_ns() - self.stamp_ns(unix_ns)


def log_time() -> RobotClock:
    """Return the clock of a log, whose stamps are Unix time."""
    return RobotClock(lambda: 0, lambda: 0)


def fixed_offset(clock_ns: Callable[[], int]) -> RobotClock:
    """Return the clock of a simulated robot: it runs at its own pace from the present Unix time on."""
    offset_ns = time.time_ns() - clock_ns()
    return RobotClock(clock_ns, lambda: clock_ns() + offset_ns)
