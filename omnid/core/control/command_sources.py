"""Sources of commands: which one drives, and which sender owns a source. The model is twist_mux of ROS."""

from __future__ import annotations

from collections import Counter
from typing import Final, NamedTuple

from omnid.core.control.heading_controller import Setpoint

OPERATOR: Final = "operator"  # has priority
PLANNER: Final = "planner"

# Reasons to refuse a command, which are counted.
LOWER_PRIORITY: Final = "a source of higher priority drives"
OTHER_SENDER: Final = "another sender drives"


class TimedSetpoint(NamedTuple):
    """A setpoint, the time of its arrival by the clock that steps the law, and where it comes from.

    age_ns: its age at its arrival, 0 where it is not known.
    """

    arrival_ns: int
    setpoint: Setpoint
    source: str = OPERATOR
    sender: str = ""  # identity of the program that sent it; empty where it is not known
    age_ns: int = 0


class CommandSelector:
    """Selects the command that drives.

    A source that has sent a command within hold_s keeps out the sources of lower priority, and the program that sent
    it keeps out other programs on the same source. A source of higher priority takes over at once; the one it replaces
    must send again. Refused commands are counted by reason. Programs without an identity count as one.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_ns = round(hold_s * 1e9)
        self.current: TimedSetpoint | None = None  # the newest accepted command
        self.refused: Counter[str] = Counter()
        self.conflict = ""  # the last two senders that have used one source at the same time, in words

    def offer(self, command: TimedSetpoint) -> None:
        """Take a command or refuse it; one that arrived before the current one changes nothing."""
        refusal = self._refusal(command)
        if refusal:
            self.refused[refusal] += 1
        elif self.current is None or command.arrival_ns >= self.current.arrival_ns:
            self.current = command

    def _refusal(self, command: TimedSetpoint) -> str:
        current = self.current
        if current is None or command.arrival_ns - current.arrival_ns > self._hold_ns:
            return ""
        if command.source == current.source:
            if command.sender == current.sender:
                return ""
            self.conflict = f"two programs send commands as {command.source!r}: those of {command.sender!r} are refused"
            return OTHER_SENDER
        return "" if command.source == OPERATOR else LOWER_PRIORITY
