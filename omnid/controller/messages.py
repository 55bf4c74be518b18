"""Messages between the daemon and the controller process.

The daemon sends a ControllerStart, then ControllerUpdates. The process sends LogRecords, a StartFailed if it cannot
start, and a TickReport (omnid.controller.statistics) for each tick.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from omnid.controller.motor_settings import MotorSettings
from omnid.core.control.contacts import NO_CONTACT, ContactState
from omnid.core.control.control_law import ControlInput, ControllerSettings
from omnid.engine.realtime import RealtimeSettings

# The wheels are ramped down when the daemon ends. Wheels that still turn after this time are stopped at once, so that
# the process ends.
LONGEST_RAMP_S: Final = 3.0


class ControllerStart(NamedTuple):
    """The settings of the process: the first message to it."""

    motor: MotorSettings
    controller: ControllerSettings
    realtime: RealtimeSettings
    waits: bool = False  # the start fails without a motor controller that answers; otherwise it is asked on


class ControllerUpdate(NamedTuple):
    """One message of the daemon: at most one update, and always the newest stop and contacts.

    Because each message repeats the stop, it arrives even if its own message was lost. stop_ns: arrival of the newest
    stop, 0 before the first one. contacts: reports of bumpers and cliff sensors on the bus.
    """

    stop_ns: int
    update: ControlInput | None
    contacts: ContactState = NO_CONTACT


class StartFailed(NamedTuple):
    """The process ends because the motor controller's settings cannot be used, or because it has not answered."""

    reason: str


class LogRecord(NamedTuple):
    """A line for the log of the daemon. The first one, whose text may be empty, means that the process is ready."""

    text: str
