"""The server: its socket, the names by which it may be called, its start and its end."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import os
import re
import signal
import socket
import sys
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from omnid.engine.logging_setup import is_journal, log_unlimited
from omnid.engine.realtime import raise_file_limit
from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig, checked
from omnid.web.access import Access, token_of
from omnid.web.feed import RobotFeed
from omnid.web.guard import Guard
from omnid.web.places import BACKLOG, Acceptor, ConnectionPlaces
from omnid.web.robot_page import RobotPage
from omnid.web.site import Site

DEFAULT_LISTEN: Final = "127.0.0.1:8447"
SILENCE_S: Final = 5  # a connection on which nothing has come within that is accepted nevertheless
REQUEST_S: Final = 5.0  # a connection that has not sent a whole request within that is closed
END_S: Final = 2  # Time that browsers have to finish at the end.
LONGEST_MESSAGE: Final = 256  # bytes, of a browser's websocket
_LISTEN: Final = re.compile(r"(\[[0-9A-Fa-f:.%]+\]|[A-Za-z0-9._-]+):(\d{1,5})")
_NAME: Final = re.compile(r"[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]")
Follow = Callable[[], Coroutine[Any, Any, None]]
_ELSEWHERE: Final = "192.0.2.1"  # an address of documentation (RFC 5737); nothing is sent there


@dataclass(frozen=True, slots=True)
class WebSettings:
    """Settings of the server."""

    listen: str = DEFAULT_LISTEN  # HOST:PORT; port 0: any
    token_file: Path | None = None
    stop_token_file: Path | None = None  # file of a second token, which may see and stop but not arm
    names: tuple[str, ...] = ()  # further names of this machine
    tls: tuple[Path, Path] | None = None  # certificate and key, PEM


def serve(bus: BusConfig, settings: WebSettings) -> None:
    """Serve the page until SIGINT or SIGTERM. Raise OmnidError for settings that cannot be used."""
    checked(bus)
    _check_names(settings.names)
    token = token_of(settings.token_file)
    stop_token = token_of(settings.stop_token_file, "--stop-token-file") if settings.stop_token_file else ""
    if token == stop_token:
        raise OmnidError("--stop-token-file has the token of --token-file, which may arm: name another file")
    if settings.token_file is None and is_journal(sys.stdout):
        raise OmnidError("omnid web prints its token, and the journal would keep it: name a --token-file")
    with _listening(settings.listen) as listener:
        host, port = listener.getsockname()[:2]
        local = ipaddress.ip_address(host).is_loopback
        own = ("localhost", "127.0.0.1", "[::1]") if local else ("localhost", *_names_of_machine())
        access = Access(
            token, frozenset(name.lower() for name in (*own, *settings.names)), not local, f"omnid_{port}", stop_token
        )
        page = RobotPage(RobotFeed(bus))
        guard = Site(page.routes(), page.metrics, access, settings.tls is not None).guard
        server = _Server(_uvicorn_config(guard, settings), guard.places)
        raise_file_limit()
        scheme = "http" if settings.tls is None else "https"
        _print_addresses(f"{scheme}://{_address(host)}:{port}/", token, stop_token)
        if not local and settings.tls is None:
            log_unlimited(
                logging.WARNING,
                "the page can be reached from the network without encryption: everyone who can listen there learns the "
                "token, and may arm the robot; use --tls-certificate and --tls-key, or a network that you trust",
            )
        asyncio.run(_run(server, page.feed.run, listener))


def _print_addresses(url: str, token: str, stop_token: str) -> None:
    """Print where the page is; with the tokens, unless the journal would keep them."""
    if is_journal(sys.stdout):
        print(f"{url} (the token is in the file of --token-file)", flush=True)
        return
    print(f"{url}?token={token}", flush=True)
    if stop_token:
        print(f"{url}?token={stop_token} (may see and stop, not arm)", flush=True)


async def _run(server: _Server, follow: Follow, listener: socket.socket) -> None:
    """Serve until a signal, or until following the robots fails."""
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            loop.add_signal_handler(number, server.end)
    following = asyncio.create_task(follow())
    following.add_done_callback(lambda _: server.end())
    await server.serve([listener])
    following.cancel()
    with suppress(asyncio.CancelledError):
        await following


class _Server(uvicorn.Server):
    """A server whose signals are handled by its caller, and whose connections have places."""

    def __init__(self, config: uvicorn.Config, places: ConnectionPlaces) -> None:
        super().__init__(config)
        self._places = places

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to accept connections."""
        assert sockets is not None

        def protocol() -> asyncio.Protocol:
            return _Protocol(config=self.config, server_state=self.server_state, app_state=self.lifespan.state)

        acceptors = [Acceptor(listener, protocol, self.config.ssl, self._places) for listener in sockets]
        self.servers = cast("list[asyncio.base_events.Server]", acceptors)  # uvicorn only closes them
        self.started = True

    def end(self) -> None:
        """Close all connections and end."""
        self.should_exit = True

    def capture_signals(self) -> Any:
        """Leave the signals alone."""
        return nullcontext()


class _Protocol(H11Protocol):
    """HTTP that closes connections on which no whole request comes in time: they would keep browsers out."""

    def connection_made(self, transport: Any) -> None:
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._wait_for_request()

    def data_received(self, data: bytes) -> None:
        """Take a part of a request; begin to wait where the last one is answered."""
        super().data_received(data)
        if self.cycle is not None and self.cycle.response_complete and self.timeout_keep_alive_task is None:
            self._wait_for_request()

    def _wait_for_request(self) -> None:
        self.loop.call_later(REQUEST_S, self._close_silent, self.cycle)

    def _close_silent(self, before: object) -> None:
        """Close the connection if no request has come since then, unless it has become a websocket."""
        if self.cycle is before and self.transport.get_protocol() is self:
            self.transport.close()


def _uvicorn_config(guard: Guard, settings: WebSettings) -> uvicorn.Config:
    certificate, key = settings.tls or (None, None)
    for option, path in (("--tls-certificate", certificate), ("--tls-key", key)):
        if path is not None and not os.access(path, os.R_OK):
            raise OmnidError(f"{option} {path}: cannot be read; name a PEM file")
    config = uvicorn.Config(
        guard,
        loop="asyncio",
        http=_Protocol,
        ws="websockets-sansio",
        interface="asgi3",
        lifespan="off",
        ws_max_size=LONGEST_MESSAGE,
        ws_ping_interval=None,
        ws_per_message_deflate=False,
        log_config=None,
        access_log=False,
        proxy_headers=False,
        server_header=False,
        timeout_graceful_shutdown=END_S,
        ssl_certfile=certificate,
        ssl_keyfile=key,
    )
    try:
        config.load()
    except OSError as error:  # of ssl
        raise OmnidError(
            f"--tls-certificate {certificate}: {error.strerror or error}; name a certificate and its key in PEM"
        ) from error
    return config


@contextmanager
def _listening(listen: str) -> Iterator[socket.socket]:
    """Yield a socket that listens on HOST:PORT. Raise OmnidError where that cannot be."""
    found = _LISTEN.fullmatch(listen)
    if found is None or int(found[2]) > 65535:
        raise OmnidError(
            f"--listen {listen}: expected HOST:PORT, such as {DEFAULT_LISTEN}, or 0.0.0.0:8447 for the network"
        )
    host, port = found[1].strip("[]"), int(found[2])
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.create_server(address[:2], family=family, backlog=BACKLOG)
        # A browser speaks first, with TLS too. The system keeps connections on which nothing has come to itself.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, SILENCE_S)
    except OSError as error:
        raise OmnidError(
            f"--listen {listen}: {error.strerror or error}; stop the other program there, or name another address"
        ) from error
    with listener:
        yield listener


def _check_names(names: tuple[str, ...]) -> None:
    for name in names:
        if not _NAME.fullmatch(name):
            raise OmnidError(f"--host {name}: expected a name without scheme and port, such as robot.example.org")


def _names_of_machine() -> tuple[str, str]:
    name = socket.gethostname()
    return name, f"{name}.local"


def _address(host: str) -> str:
    """Return the host for an address that browsers elsewhere can open."""
    if host in ("0.0.0.0", "::"):
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((_ELSEWHERE, 9))  # chooses the interface, sends nothing
            return str(probe.getsockname()[0])
        return _names_of_machine()[0]
    return f"[{host}]" if ":" in host else host
