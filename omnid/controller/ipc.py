"""A line between the daemon and a process that it has started: whole Python objects, both ways, nobody waits."""

from __future__ import annotations

import pickle
import select
import socket
from contextlib import suppress
from typing import Any, Final

NOTHING: Final = object()
_LONGEST_PACKET: Final = 1 << 16  # bytes


class Channel:
    """One end of a pair of sockets.

    Objects are pickled, so it is for two processes of one program only: neither checks what the other one says.
    lost: what the other end was too slow to take.
    """

    def __init__(self, end: socket.socket) -> None:
        """end: of a pair of SOCK_SEQPACKET."""
        self._end = end
        self.lost = 0

    def say(self, thing: object) -> None:
        """Sends one object, from any thread; drops and counts it where the other end is too slow, or gone."""
        try:
            self._end.send(pickle.dumps(thing), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:
            self.lost += 1

    def hear(self, timeout_s: float) -> Any:
        """The next object, or NOTHING within the time; EOFError once the other end has hung up."""
        try:
            select.select([self._end], [], [], max(0.0, timeout_s))
            packet = self._end.recv(_LONGEST_PACKET, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return NOTHING
        except ConnectionError:  # it is gone, and had not heard all
            packet = b""
        if not packet:
            raise EOFError
        return pickle.loads(packet)

    def hang_up(self) -> None:
        """Says no more; hears on."""
        with suppress(OSError):
            self._end.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Ends it on this side."""
        self._end.close()


def pair() -> tuple[socket.socket, socket.socket]:
    """Both ends."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
