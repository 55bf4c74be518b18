"""The places of connections. A new one always gets in: where all are taken, one that has shown no token loses its own.

Of these the oldest one of the address that has most of them goes. So neither silent connections nor half TLS handshakes
keep a stop out, which is sent as soon as its connection is there.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

MOST_CONNECTIONS: Final = 512
HANDSHAKE_S: Final = 5.0
BACKLOG: Final = 2048  # connections that wait for the event loop
_RETRY_S: Final = 0.01  # Wait where the system has no more files.
Address = tuple[str, int]


class _Place:
    """A connection, from the moment in which it is accepted."""

    def __init__(self, host: str) -> None:
        self.host, self.since_s = host, time.monotonic()
        self.is_known = False  # it has shown a token
        self.opening: asyncio.Task[None] | None = None
        self.transport: asyncio.BaseTransport | None = None

    @property
    def is_left(self) -> bool:
        """True if the connection has ended."""
        if self.transport is not None:
            return self.transport.is_closing()
        return self.opening is not None and self.opening.done()

    def end(self) -> None:
        """Close the connection at once."""
        if isinstance(self.transport, asyncio.Transport):
            self.transport.abort()
        elif self.opening is not None:
            self.opening.cancel()


class ConnectionPlaces:
    """All connections, by the address of their other end."""

    def __init__(self) -> None:
        self._places: dict[Address, _Place] = {}
        self.lost = 0  # connections that lost their place to a newer one

    def __len__(self) -> int:
        """Return the number of connections."""
        return len(self._places)

    def admit(self, address: Address) -> _Place:
        """Return a place for a new connection."""
        if len(self._places) >= MOST_CONNECTIONS:
            self._places = {key: place for key, place in self._places.items() if not place.is_left}
        while len(self._places) >= MOST_CONNECTIONS:
            self.free_one()
        place = self._places[address] = _Place(address[0])
        return place

    def free_one(self) -> None:
        """End the connection that is missed least."""
        candidates = {key: place for key, place in self._places.items() if not place.is_known} or self._places
        if not candidates:
            return
        ((host, _),) = Counter(place.host for place in candidates.values()).most_common(1)
        oldest = next(key for key, place in candidates.items() if place.host == host)  # they are kept in their order
        self._places.pop(oldest).end()
        self.lost += 1

    def know(self, address: object) -> None:
        """Take note that a connection has shown a token; address: that of an ASGI scope."""
        place = self._places.get(tuple(address)) if isinstance(address, list | tuple) else None
        if place is not None:
            place.is_known = True


class Acceptor:
    """Accepts connections and opens them, with TLS or without; it takes the place of a server of asyncio."""

    def __init__(
        self,
        listener: socket.socket,
        protocol: Callable[[], asyncio.Protocol],
        tls: ssl.SSLContext | None,
        places: ConnectionPlaces,
    ) -> None:
        """Begin to accept, in the running event loop; listener: listens already."""
        listener.setblocking(False)
        self._listener, self._protocol, self._tls, self._places = listener, protocol, tls, places
        self._accepting = asyncio.create_task(self._accept())

    def close(self) -> None:
        """Accept no more."""
        self._accepting.cancel()

    async def wait_closed(self) -> None:
        """Return when no more connections are accepted."""
        await asyncio.wait([self._accepting])

    async def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, address = await loop.sock_accept(self._listener)
            except OSError:  # it has gone before, or the system has no more files
                self._places.free_one()
                await asyncio.sleep(_RETRY_S)
                continue
            place = self._places.admit((address[0], address[1]))
            place.opening = asyncio.create_task(self._open(connection, place))

    async def _open(self, connection: socket.socket, place: _Place) -> None:
        timeout: Any = HANDSHAKE_S if self._tls else None
        with suppress(OSError, asyncio.CancelledError):  # errors of TLS are OSErrors
            place.transport, _ = await asyncio.get_running_loop().connect_accepted_socket(
                self._protocol, connection, ssl=self._tls, ssl_handshake_timeout=timeout
            )
            return
        connection.close()
