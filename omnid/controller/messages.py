"""What the daemon and the process that steers say to each other; beside these, each tick (omnid.controller.statistics)."""

from __future__ import annotations

from typing import Final, NamedTuple

from omnid.config import MotorConfig, RealtimeConfig
from omnid.controller.controller import Arrived, Heading, HelmSettings

LONGEST_RAMP_S: Final = 3.0  # at the end: whatever has not stood still by then is stopped at once


class Orders(NamedTuple):
    """What the process is to do."""

    motor: MotorConfig
    settings: HelmSettings
    realtime: RealtimeConfig


class Heard(NamedTuple):
    """What the daemon says: something new, or nothing, and always when a stop was asked for last."""

    stop_ns: int
    news: Heading | Arrived | None


class Refused(NamedTuple):
    """Why the process cannot steer."""

    why: str


class Remark(NamedTuple):
    """A line for the journal; the first one, empty or not, says that the process steers."""

    text: str
