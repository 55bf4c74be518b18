"""The channel between the daemon and the controller process, and the messages on it.

The daemon sends a ControllerStart, then ControllerUpdates. The process sends LogRecords, a StartFailed if it cannot
start, and a TickReport with its state for each tick.
"""

from __future__ import annotations

import pickle
import select
import socket
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final, NamedTuple

from drivers.motion import WheelSample
from drivers.motor import VelocityCommand
from omnid.controller.motor import MotorSettings
from omnid.core.control.arming import NO_CONTACT, ContactState
from omnid.core.control.collision_monitor import remedy
from omnid.core.control.control_law import ControlInput, ControllerSettings, ControllerState
from omnid.core.control.motion_monitor import ADVICE, CONFLICTS, DISAGREEMENTS, MOTION_DOUBTFUL, Conflict
from omnid.core.control.safety_rules import ENDS, IDLE
from omnid.engine.process import RealtimeSettings

# The wheels are ramped down when the daemon ends. Wheels that still turn after this time are stopped at once, so that
# the process ends.
LONGEST_RAMP_S: Final = 3.0


class ControllerStart(NamedTuple):
    """The settings of the process: the first message to it."""

    motor: MotorSettings
    controller: ControllerSettings
    realtime: RealtimeSettings


class ControllerUpdate(NamedTuple):
    """One message of the daemon: at most one update, and always the newest stop and contacts.

    Because each message repeats the stop, it arrives even if its own message was lost. stop_ns: arrival of the newest
    stop, 0 before the first one. contacts: reports of bumpers and cliff sensors on the bus.
    """

    stop_ns: int
    update: ControlInput | None
    contacts: ContactState = NO_CONTACT


class StartFailed(NamedTuple):
    """The process ends because the motor controller's settings cannot be used."""

    reason: str


class LogRecord(NamedTuple):
    """A line for the log of the daemon. The first one, whose text may be empty, means that the process is ready."""

    text: str


UNTIL_ARMED: Final = "they stay stopped until cmd/arm (`omnid arm`)"
ARMED: Final = "armed by cmd/arm"


def cuts_drive_short(before: ControllerState, after: ControllerState) -> bool:
    """True if wheels that were allowed to turn must stop now, for another reason than a missing command."""
    return not before.reason and after.reason not in ("", IDLE)


def transitions(before: ControllerState, after: ControllerState, conflict: Conflict) -> Iterator[str]:
    """Yield lines for the log that say what has changed from one tick to the next.

    conflict: how images, wheels and gyro differ, where they do.
    """
    detail = {conflict.reason: f" {conflict.detail}"} if conflict.detail else {}
    # 1. Arming: each time, and a refusal where its reason is another one.
    answer, last = after.arm_answer, before.arm_answer
    if answer != last and (not answer.refusal or answer.refusal != last.refusal):
        yield f"arming is refused: {answer.refusal}" if answer.refusal else ARMED
    # 2. A reason to drive slowly that a person should examine.
    if after.slowed_by != before.slowed_by and after.slowed_by in (MOTION_DOUBTFUL, *CONFLICTS):
        yield f"the wheels turn slowly: {after.slowed_by}{detail.get(after.slowed_by, '')}"
    # 3. A stop by the collision monitor.
    if after.blocked and not before.blocked:
        yield f"the wheels stop: {after.obstacle}; {remedy(after.obstacle)}"
    # 4. The end of a drive, unless it was asked for.
    if cuts_drive_short(before, after) and after.reason != ENDS:
        latched = f"; {UNTIL_ARMED}" if after.needs_request else ""
        advice = f"; {ADVICE}" if after.reason in DISAGREEMENTS else ""
        yield f"the wheels stop: {after.reason}{detail.get(after.reason, '')}{advice}{latched}"


class TickReport(NamedTuple):
    """The result of one tick."""

    command: VelocityCommand | None  # command that the motor controller accepted
    late_s: float  # delay of the tick
    work_s: float
    state: ControllerState
    wheels: WheelSample | None = None  # wheels as the motor controller reports them


NO_MESSAGE: Final = object()
_LONGEST_PACKET: Final = 1 << 16  # bytes


class Channel:
    """One end of a pair of sockets.

    Objects are pickled, so it is for two processes of one program only: neither end checks what it receives.
    """

    def __init__(self, end: socket.socket) -> None:
        """end: one of a pair of SOCK_SEQPACKET."""
        self._end = end

    def send(self, message: object) -> None:
        """Send one object, from any thread; drop it where the other end is too slow or has closed."""
        with suppress(OSError):
            self._end.send(pickle.dumps(message), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)

    def receive(self, timeout_s: float) -> Any:
        """Return the next object, NO_MESSAGE after the timeout; EOFError once the other end sends no more."""
        try:
            select.select([self._end], [], [], max(0.0, timeout_s))
            packet = self._end.recv(_LONGEST_PACKET, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return NO_MESSAGE
        except ConnectionError:  # the other end has closed before it had received all
            packet = b""
        if not packet:
            raise EOFError
        return pickle.loads(packet)

    def finish_sending(self) -> None:
        """Send the end: the other end's `receive` raises EOFError after what was sent. Receiving is still possible."""
        with suppress(OSError):
            self._end.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Close this end."""
        self._end.close()


def socket_pair() -> tuple[socket.socket, socket.socket]:
    """Return both ends of a new pair."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
