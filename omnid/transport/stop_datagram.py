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
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Final

from omnid.transport.session import BusConfig, needs_proof

ASKED: Final = "asked"  # the daemon has passed the stop on
STOPPED: Final = "stopped"  # the robot is disarmed by a stop
REPEAT_S: Final = 0.05
MAX_PER_PASS: Final = 16  # Most datagrams that one pass reads of a socket during a flood.
_HEAD: Final = b"omnid stop 1 "
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

    def __init__(self, config: BusConfig, on_stop: Callable[[], object], is_stopped: Callable[[], bool]) -> None:
        """on_stop: called for each request. is_stopped: True if the robot is disarmed by a stop."""
        self._robot, self._on_stop, self._is_stopped = config.robot.encode(), on_stop, is_stopped
        self._longest = 2 * len(_request(config.robot))  # bytes that are read of a datagram, so that a tail is seen
        own, proves = ("localhost", "127.0.0.1", "::1"), needs_proof(config)
        found = [(host if host in own or not proves else own[1], port) for host, port in addresses(config.listen)]
        self._sockets = _sockets(found, listens=True)
        self._poll = select.poll()
        for listener in self._sockets:
            self._poll.register(listener, select.POLLIN)

    def process(self) -> None:
        """Take the requests that have come, a bounded number, or wait for one."""
        self._poll.poll(1000 * REPEAT_S)
        for listener in self._sockets:
            for _ in range(MAX_PER_PASS):
                with suppress(OSError):  # there is no more, or an earlier answer could not be delivered
                    data, sender = listener.recvfrom(self._longest)
                    found = _REQUEST.fullmatch(data)
                    if found is not None and found[2] == self._robot:
                        self._on_stop()
                        state = STOPPED if self._is_stopped() else ASKED
                        listener.sendto(_HEAD + found[1] + b" " + state.encode(), sender)

    def close(self) -> None:
        """Close the ports."""
        for listener in self._sockets:
            listener.close()


class StopSender:
    """The client of a stop: it asks all endpoints at the same time."""

    def __init__(self, robot: str, endpoints: Sequence[str]) -> None:
        self._request = _request(robot)
        head = self._request[: -len(robot.encode()) - len(STOPPED)]
        self._answers = {head + state.encode(): state for state in (ASKED, STOPPED)}
        self._sockets = _sockets(addresses(endpoints), listens=False)

    def ask(self, wait_s: float) -> str:
        """Ask for a stop again and again until it is confirmed; return the best answer within the time, "" without."""
        answer, deadline_s = "", time.monotonic() + wait_s
        while answer != STOPPED:
            for sender in self._sockets:
                with suppress(OSError):  # no program listens there
                    sender.send(self._request)
            time.sleep(min(REPEAT_S, max(0.0, deadline_s - time.monotonic())))
            for sender in self._sockets:
                with suppress(OSError):  # there is no more, or no program listens there
                    for _ in range(MAX_PER_PASS):
                        if answer != STOPPED:  # an older answer may come later, by another way
                            answer = self._answers.get(sender.recv(len(self._request)), answer)
            if time.monotonic() >= deadline_s:
                break
        return answer

    def close(self) -> None:
        """Close the sockets."""
        for sender in self._sockets:
            sender.close()


def _request(robot: str) -> bytes:
    """Return a request with a new nonce; no answer is longer."""
    return _HEAD + secrets.token_hex(8).encode() + b" " + robot.encode() + b" " * len(STOPPED)


def _sockets(found: Iterable[tuple[str, int]], *, listens: bool) -> list[socket.socket]:
    """Return sockets for datagrams at hosts and ports, or to them; those that cannot be had are of no effect."""
    opened = []
    for host, port in found:
        with suppress(OSError):
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            opened.append(socket.socket(family, socket.SOCK_DGRAM))
            opened[-1].setblocking(False)
            (opened[-1].bind if listens else opened[-1].connect)(address)
    return opened
