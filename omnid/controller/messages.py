"""Messages between the daemon and the controller process; each tick is a TickReport (controller.statistics)."""

from __future__ import annotations

from typing import Final, NamedTuple

from omnid.controller.motor_settings import MotorSettings
from omnid.core.control.arming import ArmRequest
from omnid.core.control.collision_monitor import ControllerRing
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.contacts import NO_CONTACT, ContactState
from omnid.core.control.control_law import ControllerPose, ControllerSettings
from omnid.engine.realtime import RealtimeSettings

LONGEST_RAMP_S: Final = 3.0  # at the end: wheels that have not come to a stop within it are stopped at once


class ControllerStart(NamedTuple):
    """The settings of the process: the first message to it."""

    motor: MotorSettings
    controller: ControllerSettings
    realtime: RealtimeSettings


class ControllerUpdate(NamedTuple):
    """One message of the daemon: a pose, a ring, a setpoint or a request to arm, if any; always the last stop and the
    contacts.

    So a stop arrives with the next message that does, even if its own was lost.
    """

    stop_ns: int  # 0: none
    update: ControllerPose | ControllerRing | TimedSetpoint | ArmRequest | None
    contacts: ContactState = NO_CONTACT  # of bumpers and cliff sensors on the bus


class StartFailed(NamedTuple):
    """The process cannot open the motor controller."""

    reason: str


class LogRecord(NamedTuple):
    """A line for the log of the daemon; the first one, which may be empty, reports that the process is ready."""

    text: str
