"""State of the navigation: one enum for planner, messages, status, bus and programs. Imports no numpy."""

from __future__ import annotations

from enum import StrEnum


class NavigationState(StrEnum):
    """State of a goal, a path or a route. The values are the words used on the bus and in logs."""

    IDLE = "idle"  # nothing has been asked for since the start
    DRIVING = "driving"
    AVOIDING = "avoiding"  # off the path, around an obstacle
    BLOCKED = "blocked"  # waits for the way to become free
    PAUSED = "paused"  # paused by a command, or by a fault that a person must see to; `resume` continues
    NOT_LOCALISED = "not localised"  # waits for the pose in the map
    REACHED = "reached"
    CANCELLED = "cancelled"
    FAILED = "failed"

    @property
    def is_end(self) -> bool:
        """True if nothing is under way: the wheels are given no setpoint."""
        return self in (self.IDLE, self.REACHED, self.CANCELLED, self.FAILED)


def with_reason(state: str, reason: str) -> str:
    """Return a state with its reason, for people."""
    return f"{state}: {reason}" if reason else str(state)
