"""Sources of commands: which one drives, and which sender owns a source. The model is twist_mux of ROS."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from msgspec import Meta

from omnid.core.control.heading_controller import Setpoint
from omnid.errors import OmnidError

OPERATOR: Final = "operator"
PLANNER: Final = "planner"
_NAME: Final = re.compile(r"[a-z][a-z0-9_]{0,31}")
# Topics below cmd/.
_RESERVED: Final = ("twist", "heading", "stop", "arm", "bumper", "cliff", "goal", "path", "navigation", "route")

# Reasons to refuse a command, which are counted.
UNKNOWN_SOURCE: Final = "unknown source"
LOWER_PRIORITY: Final = "a source of higher priority drives"
OTHER_SENDER: Final = "another sender drives"


@dataclass(frozen=True, slots=True)
class SourceSettings:
    """Sources of commands in the order of their priority."""

    names: Annotated[
        tuple[str, ...],
        "sources of commands, highest priority first: topics "
        "cmd/NAME/twist and cmd/NAME/heading; cmd/twist and cmd/heading are the first one's",
    ] = (OPERATOR, PLANNER)
    hold_s: Annotated[
        float,
        Meta(ge=0.05, le=60),
        "a source keeps out those of lower priority, and its sender all others, for so long "
        "after its newest command, s",
    ] = 0.5

    def __post_init__(self) -> None:
        """Raise OmnidError for names that cannot be part of a topic or are one already, and for one given twice."""
        usable = {name for name in self.names if _NAME.fullmatch(name) and name not in _RESERVED}
        if not 0 < len(usable) == len(self.names):
            raise OmnidError(
                f"controller.sources.names has {list(self.names)}; give one or more of small letters, digits and '_', "
                f"each once, none of {', '.join(_RESERVED)}"
            )


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

    def __init__(self, settings: SourceSettings) -> None:
        self._priorities = {name: priority for priority, name in enumerate(settings.names)}
        self._hold_ns = round(settings.hold_s * 1e9)
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
        if command.source not in self._priorities:
            return UNKNOWN_SOURCE
        current = self.current
        if current is None or command.arrival_ns - current.arrival_ns > self._hold_ns:
            return ""
        if command.source == current.source:
            if command.sender == current.sender:
                return ""
            self.conflict = f"two programs send commands as {command.source!r}: those of {command.sender!r} are refused"
            return OTHER_SENDER
        higher = self._priorities[command.source] < self._priorities[current.source]
        return "" if higher else LOWER_PRIORITY
