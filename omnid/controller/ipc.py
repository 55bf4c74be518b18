"""A channel between the daemon and a process that it has started: whole Python objects, both ways, without waiting."""

from __future__ import annotations

import pickle
import select
import socket
from contextlib import suppress
from typing import Any, Final

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
