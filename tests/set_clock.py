"""The two clocks of a computer, of which a test sets one."""

from __future__ import annotations

from omnid.engine.robot_clock import RobotClock


class SetClock:
    """CLOCK_MONOTONIC begins at 0, and is the same until `advance`; Unix time differs from it by an offset."""

    def __init__(self, offset_ns: int) -> None:
        self.monotonic_ns, self.offset_ns = 0, offset_ns

    @property
    def unix_ns(self) -> int:
        """Unix time."""
        return self.monotonic_ns + self.offset_ns

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        self.monotonic_ns += round(seconds * 1e9)

    def set_forwards(self, seconds: float) -> None:
        """Set Unix time; below 0: back."""
        self.offset_ns += round(seconds * 1e9)

    def clock(self) -> RobotClock:
        """Return the robot's clock on this computer."""
        return RobotClock(lambda: self.monotonic_ns, lambda: self.unix_ns)
