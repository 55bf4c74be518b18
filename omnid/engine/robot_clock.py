"""The time of a robot: CLOCK_MONOTONIC for all stamps inside, and its offset to Unix time, which is followed.

A computer's clock is set while a robot runs: by NTP, by hand, at each boot of a board without a battery. Nothing inside
changes by that: durations, ages, rates and deadlines are differences of CLOCK_MONOTONIC. On the bus and in recordings a
stamp s is the Unix time

    unix(s) = s + offset(s)

with the offset that was in force at s, so a stamp has one Unix time in however many messages it is sent. Linux slews
both clocks alike; an offset that changes by more than slewing can, and by more than STEP_NS, has made a step, which is
reported. Smaller changes are followed in silence.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final, NamedTuple

from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.engine.graph import nothing
from omnid.engine.threads import Lock

SLEW: Final = 500e-6  # most by which NTP changes the rate of a clock: MAXFREQ of the kernel's timex.h
STEP_NS: Final = 1_000_000  # less than two images of a pair are apart
FOLLOW_NS: Final = NS_PER_S  # time between two offsets that are followed in silence
WARNED_S: Final = 60.0  # The status warns of a step of the clock for this time: people look at it now and then.
KEPT: Final = 64  # offsets that are remembered: stamps of the last minute, whatever the clock does
END_NS: Final = 2**31 * NS_PER_S  # of the times of ROS, which begin in 1970 and end in 2038
READINGS: Final = 3  # of both clocks: the one with the least time between them counts, else stamps jump by its error


class _Offset(NamedTuple):
    """An offset from CLOCK_MONOTONIC to Unix time, and the stamp from which on it is in force; -inf for the first."""

    since_ns: float
    offset_ns: int


class ClockStep(NamedTuple):
    """A step of Unix time: when it was found, by CLOCK_MONOTONIC, and by how much; forwards is positive."""

    at_ns: int
    change_ns: int

    @property
    def words(self) -> str:
        """The step in words."""
        side = "forwards" if self.change_ns > 0 else "back"
        return f"{side} by {duration_words(self.change_ns * S_PER_NS)}"


class RobotClock:
    """Both clocks of a run; for any thread.

    steps, step: number of steps, and the newest one.
    """

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = lambda: time.time_ns(),
        report: Callable[[str], object] = nothing,
    ) -> None:
        """monotonic_ns: the clock of the stamps. unix_ns: the clock that may be set. report: takes a line at a step."""
        self.monotonic_ns = monotonic_ns
        self._unix_ns, self._report = unix_ns, report
        self._following = Lock()
        offset_ns, _, self._right_ns = self._measured()
        self._adopted_ns, self._is_time = self._right_ns, 0 <= self._right_ns + offset_ns < END_NS
        self._offsets: tuple[_Offset, ...] = (_Offset(-math.inf, offset_ns if self._is_time else 0),)
        self.steps, self.step = 0, ClockStep(0, 0)

    def follow(self) -> None:
        """Measure the offset, follow it, and report a step; while another thread does, nothing is to be done."""
        if not self._following.acquire(blocking=False):
            return
        try:
            line = self._followed()
        finally:
            self._following.release()
        if line:
            self._report(line)

    def _followed(self) -> str:
        """Follow the offset; return what is to be reported."""
        # 1. By how much has it changed, and by how much can slewing have changed it since it was right?
        offset_ns, error_ns, now_ns = self._measured()
        was_time, self._is_time = self._is_time, 0 <= now_ns + offset_ns < END_NS
        if not self._is_time:  # no message can hold it
            line = "the computer's clock was set to a time outside 1970 to 2038: stamps go on as before"
            return line if was_time else ""
        change_ns = offset_ns - self._offsets[-1].offset_ns
        if abs(change_ns) <= error_ns:
            self._right_ns = now_ns
            return ""
        is_step = abs(change_ns) > STEP_NS + error_ns + SLEW * (now_ns - self._right_ns)
        if not is_step and now_ns - self._adopted_ns < FOLLOW_NS:
            return ""
        # 2. The new offset is in force for stamps from now on.
        self._right_ns = self._adopted_ns = now_ns
        self._offsets = (*self._offsets, _Offset(now_ns, offset_ns))[-KEPT:]
        if not is_step:
            return ""
        self.steps, self.step = self.steps + 1, ClockStep(now_ns, change_ns)
        return (
            f"the computer's clock was set {self.step.words}: stamps on the bus and in recordings follow it, "
            "a recording goes on in a new file; ages and deadlines do not change"
        )

    def offset_ns(self, stamp_ns: int) -> int:
        """Return the offset from a stamp to Unix time, as it was last measured before the stamp."""
        return next((one.offset_ns for one in reversed(self._offsets) if one.since_ns <= stamp_ns), self._offsets[0][1])

    def unix_ns(self, stamp_ns: int) -> int:
        """Return the Unix time of a stamp."""
        self.follow()
        return stamp_ns + self.offset_ns(stamp_ns)

    def stamp_ns(self, unix_ns: int) -> int:
        """Return the stamp of a Unix time: of all that have it, before and after a step, the nearest to now.

        A Unix time that a step has left out is one of a clock that was not set: it counts by the newest offset.
        """
        self.follow()
        now_ns, offsets = self.monotonic_ns(), self._offsets
        stamps = [unix_ns - one.offset_ns for one in offsets]
        in_force = [stamp for stamp in stamps if stamp + self.offset_ns(stamp) == unix_ns]
        return min(in_force, key=lambda stamp: abs(now_ns - stamp), default=stamps[-1])

    def age_ns(self, unix_ns: int) -> int:
        """Return the time since a Unix time; below 0 where it is to come."""
        return self.monotonic_ns() - self.stamp_ns(unix_ns)

    def stats(self) -> dict[str, object]:
        """Return the steps of the clock, and of the newest its size and the time since it [s]."""
        self.follow()
        if not self.steps:
            return {"steps": 0, "_words": "followed"}
        change_s, since_s = (ns * S_PER_NS for ns in (self.step.change_ns, self.monotonic_ns() - self.step.at_ns))
        severity = "_warning" if since_s < WARNED_S else "_words"
        words = {severity: f"it was set {self.step.words}: the stamps follow it"}
        return {"steps": self.steps, "step_s": f"{change_s:.3f}", "since_s": round(since_s), **words}

    def _measured(self) -> tuple[int, int, int]:
        """Return the offset, its largest error, and the time of the measurement [ns]."""
        readings = []
        for _ in range(READINGS):
            before_ns, unix_ns, after_ns = self.monotonic_ns(), self._unix_ns(), self.monotonic_ns()
            readings.append((after_ns - before_ns, unix_ns - (before_ns + after_ns) // 2, after_ns))
        error_ns, offset_ns, now_ns = min(readings)
        return offset_ns, error_ns, now_ns


def log_time() -> RobotClock:
    """Return the clock of a log, whose stamps are Unix time."""
    return RobotClock(lambda: 0, lambda: 0)


def fixed_offset(clock_ns: Callable[[], int]) -> RobotClock:
    """Return the clock of a simulated robot: it runs at its own pace from the Unix time of now on."""
    offset_ns = time.time_ns() - clock_ns()
    return RobotClock(clock_ns, lambda: clock_ns() + offset_ns)


class SegmentTime:
    """The Unix time in a recording, whose files have no step in them: each step begins a new file.

    What belongs to the time before a step, but comes after it, has the time of the new file.
    """

    def __init__(self, clock: RobotClock) -> None:
        self.clock, self._step = clock, clock.step

    def is_over(self) -> bool:
        """True, once, after a step."""
        self.clock.follow()
        before, self._step = self._step, self.clock.step
        return self._step != before

    def unix_ns(self, stamp_ns: int) -> int:
        """Return the Unix time of a stamp in this segment."""
        return stamp_ns + self.clock.offset_ns(max(stamp_ns, self._step.at_ns))


def duration_words(seconds: float) -> str:
    """Return a duration in the unit in which a person would say it."""
    seconds = abs(seconds)
    units = (("days", 86_400.0, 2.0), ("h", 3_600.0, 1.0), ("min", 60.0, 2.0), ("s", 1.0, 1.0))
    name, unit_s = next(((name, unit_s) for name, unit_s, least in units if seconds >= least * unit_s), ("ms", 1e-3))
    amount = seconds / unit_s
    return f"{amount:.0f} {name}" if amount >= 100.0 else f"{amount:.3g} {name}"
