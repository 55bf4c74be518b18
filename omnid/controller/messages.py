"""Messages between the daemon and the controller process; each tick is a TickReport (controller.statistics)."""

from __future__ import annotations

from typing import Final, NamedTuple

from omnid.config import MotorConfig, RealtimeConfig
from omnid.controller.controller import ControllerPose, ControllerSettings, TimedSetpoint

LONGEST_RAMP_S: Final = 3.0  # at the end: whatever has not stood still by then is stopped at once


class ControllerStart(NamedTuple):
    """What the process is to do."""

    motor: MotorConfig
    settings: ControllerSettings
    realtime: RealtimeConfig


class ControllerUpdate(NamedTuple):
    """What the daemon says: something new, or nothing, and always when a stop was asked for last."""

    stop_ns: int
    news: ControllerPose | TimedSetpoint | None


class StartFailed(NamedTuple):
    """Why the process cannot steer."""

    why: str


class LogRecord(NamedTuple):
    """A line for the journal; the first one, empty or not, says that the process steers."""

    text: str
