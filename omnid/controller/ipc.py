"""The channel between the daemon and the controller process, and the messages on it.

The daemon sends a ControllerStart, then ControllerUpdates. The process sends LogRecords, a StartFailed if it cannot
start, and a TickReport (omnid.controller.statistics) for each tick.
"""

from __future__ import annotations

import pickle
import select
import socket
from contextlib import suppress
from typing import Any, Final, NamedTuple

from omnid.controller.motor import MotorSettings
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


NO_MESSAGE: Final = object()
_LONGEST_PACKET: Final = 1 << 16  # bytes


class Channel:
    """One end of a pair of sockets.

    Objects are pickled, so it is for two processes of one program only: neither end checks what it receives.
    lost: messages that the other end was too slow to take.
    """

    def __init__(self, end: socket.socket) -> None:
        """end: one of a pair of SOCK_SEQPACKET."""
        self._end = end
        self.lost = 0

    def send(self, message: object) -> None:
        """Send one object, from any thread; drop and count it where the other end is too slow or has closed."""
        try:
            self._end.send(pickle.dumps(message), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:
            self.lost += 1

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
