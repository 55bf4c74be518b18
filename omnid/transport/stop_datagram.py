"""Stops by datagrams, apart from the sessions of zenoh: they need no connection, so no crowd keeps them out.

A daemon takes them at the UDP port of the same number as each endpoint that it listens on. Where the configuration asks
for users or certificates, at that port of this machine's own address only: everyone who can connect may stop, and a
datagram proves nothing. A request is "omnid stop 1 NONCE ROBOT", its answer "omnid stop 1 NONCE asked" or "...
stopped", which is never longer.
"""

from __future__ import annotations

import re
import secrets
import select
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any, Final

from omnid.transport.bus_config import BusConfig
from omnid.transport.session import needs_proof

ASKED: Final = "asked"  # the daemon has passed the stop on
STOPPED: Final = "stopped"  # the robot is disarmed by a stop
REPEAT_S: Final = 0.05
MOST_PER_PASS: Final = 16  # Most datagrams that one pass reads during a flood.
_HEAD: Final = b"omnid stop 1 "
_LONGEST: Final = 512  # bytes
_REQUEST: Final = re.compile(rb"omnid stop 1 ([0-9a-f]{16}) ([!-~]{1,256}) *")
_ENDPOINT: Final = re.compile(r"(?:tcp|tls|ws)/(.+):(\d{1,5})(?:[?#].*)?")  # those whose UDP port is free


def addresses(endpoints: Sequence[str]) -> Iterator[tuple[str, int]]:
    """Yield host and port of those endpoints of zenoh to which a stop may be sent by datagram."""
    for endpoint in endpoints:
        found = _ENDPOINT.fullmatch(endpoint)
        if found is not None and 0 < int(found[2]) < 65536:
            yield found[1].strip("[]"), int(found[2])


class StopListener:
    """The daemon's end. An address that is in use is left out: stops by the bus are as before."""

    def __init__(self, config: BusConfig, on_stop: Callable[[], None], is_stopped: Callable[[], bool]) -> None:
        """on_stop: called for each request. is_stopped: True if the robot is disarmed by a stop."""
        self._robot, self._on_stop, self._is_stopped = config.robot.encode(), on_stop, is_stopped
        self._sockets: list[socket.socket] = []
        self._poll = select.poll()
        proves = needs_proof(config)
        for host, port in addresses(config.listen):
            if proves and host not in ("localhost", "127.0.0.1", "::1"):
                host = "127.0.0.1"
            with suppress(OSError):
                self._sockets.append(_bound(host, port))
                self._poll.register(self._sockets[-1], select.POLLIN)

    def process(self) -> None:
        """Take the requests that have come, a bounded number, or wait for one."""
        self._poll.poll(1000 * REPEAT_S)
        for listener in self._sockets:
            for _ in range(MOST_PER_PASS):
                try:
                    data, sender = listener.recvfrom(_LONGEST)
                except BlockingIOError:
                    break
                except OSError:  # of an earlier answer that could not be delivered
                    continue
                self._answer(listener, data, sender)

    def close(self) -> None:
        """Close the ports."""
        for listener in self._sockets:
            listener.close()

    def _answer(self, listener: socket.socket, data: bytes, sender: tuple[Any, ...]) -> None:
        found = _REQUEST.fullmatch(data)
        if found is None or found[2] != self._robot:
            return
        self._on_stop()
        state = STOPPED if self._is_stopped() else ASKED
        with suppress(OSError):
            listener.sendto(_HEAD + found[1] + b" " + state.encode(), sender)


class StopSender:
    """The client of a stop: it asks all endpoints at the same time."""

    def __init__(self, robot: str, endpoints: Sequence[str]) -> None:
        self._nonce = secrets.token_hex(8).encode()
        # No answer is longer than its request.
        self._request = _HEAD + self._nonce + b" " + robot.encode() + b" " * len(STOPPED)
        self._sockets: list[socket.socket] = []
        for host, port in addresses(endpoints):
            with suppress(OSError):
                family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
                sender = socket.socket(family, socket.SOCK_DGRAM)
                self._sockets.append(sender)
                sender.connect(address)
                sender.setblocking(False)

    def ask(self, wait_s: float) -> str:
        """Ask for a stop again and again until it is confirmed; return the best answer within the time, "" without."""
        answer, deadline_s = "", time.monotonic() + wait_s
        while answer != STOPPED:
            for sender in self._sockets:
                with suppress(OSError):  # no program listens there
                    sender.send(self._request)
            time.sleep(min(REPEAT_S, max(0.0, deadline_s - time.monotonic())))
            answer = max((self._answer(sender) for sender in self._sockets), key=len, default="") or answer
            if time.monotonic() >= deadline_s:
                break
        return answer

    def close(self) -> None:
        """Close the sockets."""
        for sender in self._sockets:
            sender.close()

    def _answer(self, sender: socket.socket) -> str:
        """Return the newest answer that has come, "" where there is none."""
        answer = ""
        for _ in range(MOST_PER_PASS):
            try:
                data = sender.recv(_LONGEST)
            except OSError:  # there is no more, or no program listens there
                break
            for state in (ASKED, STOPPED):
                if data == _HEAD + self._nonce + b" " + state.encode():
                    answer = state
        return answer


def _bound(host: str, port: int) -> socket.socket:
    family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    listener = socket.socket(family, socket.SOCK_DGRAM)
    try:
        listener.setblocking(False)
        listener.bind(address)
    except OSError:
        listener.close()
        raise
    return listener
