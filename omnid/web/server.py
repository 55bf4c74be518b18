"""The server: the names by which it may be called, the cookie for the token, its start and its end."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import os
import re
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final

import uvicorn
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from omnid.engine.logging_setup import is_journal, log
from omnid.errors import OmnidError
from omnid.transport.bus_config import BusConfig
from omnid.web.access import REFUSALS, Access, Guard, is_of_other_site, token_of
from omnid.web.feed import RobotFeed
from omnid.web.metrics import metrics
from omnid.web.robot import RobotPage

DEFAULT_LISTEN: Final = "127.0.0.1:8447"
STATIC: Final = Path(__file__).with_name("static")
COOKIE_S: Final = 30 * 86_400  # A browser keeps the cookie for this time.
END_S: Final = 2  # Time that browsers have to finish at the end.
# A link of another site brings no cookie along (SameSite=Strict); a page that loads itself again does.
_AGAIN: Final = '<!DOCTYPE html><title>omnid</title><meta http-equiv="refresh" content="0">'
_LISTEN: Final = re.compile(r"(\[[0-9A-Fa-f:.%]+\]|[A-Za-z0-9._-]+):(\d{1,5})")
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
    # 1. Read the tokens.
    token = token_of(settings.token_file)
    stop_token = token_of(settings.stop_token_file, "--stop-token-file") if settings.stop_token_file else ""
    if token == stop_token:
        raise OmnidError("--stop-token-file has the token of --token-file, which may arm: name another file")
    if settings.token_file is None and is_journal(sys.stdout):
        raise OmnidError("omnid web prints its token, and the journal would keep it: name a --token-file")
    with _listening(settings.listen) as listener:
        # 2. Build the page.
        host, port = listener.getsockname()[:2]
        local = ipaddress.ip_address(host).is_loopback
        name = socket.gethostname()
        own = ("localhost", "127.0.0.1", "[::1]") if local else ("localhost", name, f"{name}.local")
        hosts = frozenset(name.lower() for name in (*own, *settings.names))
        access = Access(token, hosts, not local, f"omnid_{port}", stop_token)
        page = RobotPage(RobotFeed(bus))
        server = _Server(_uvicorn_config(site(page, access, secure=settings.tls is not None), settings))
        # 3. Print where it is; with the tokens, unless the journal would keep them.
        url = f"{'https' if settings.tls else 'http'}://{_address(host)}:{port}/"
        if is_journal(sys.stdout):
            print(f"{url} (the token is in the file of --token-file)", flush=True)
        else:
            print(f"{url}?token={token}", flush=True)
            if stop_token:
                print(f"{url}?token={stop_token} (may see and stop, not arm)", flush=True)
        if not local and settings.tls is None:
            log(
                logging.WARNING,
                "the page can be reached from the network without encryption: everyone who can listen there learns the "
                "token, and may arm the robot; use --tls-certificate and --tls-key, or a network that you trust",
            )
        # 4. Serve.
        asyncio.run(_run(server, page.feed, listener))


def site(page: RobotPage, access: Access, *, secure: bool) -> Guard:
    """Return the server's application. secure: it speaks TLS, so that browsers send the cookie over TLS only."""

    async def index(request: Request) -> Response:
        """Return the page; let a browser in that names the token."""
        if (token := request.query_params.get("token")) is not None and (role := access.role_of(token)) is not None:
            response = RedirectResponse("/", HTTPStatus.SEE_OTHER)
            value = access.new_cookie(role)
            response.set_cookie(access.cookie, value, COOKIE_S, httponly=True, samesite="strict", secure=secure)
            return response
        if token is None and access.role(request) is not None:
            return FileResponse(STATIC / "index.html")
        if token is None and is_of_other_site(request):
            return HTMLResponse(_AGAIN)
        return PlainTextResponse(f"omnid web: {REFUSALS['no token']}\n", HTTPStatus.UNAUTHORIZED)

    async def numbers(_: Request) -> Response:
        return PlainTextResponse(metrics(page.feed.state), media_type=CONTENT_TYPE_LATEST)

    outer = [
        Route("/", index),
        Route("/metrics", numbers),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]
    return Guard(Starlette(routes=[*outer, *page.routes()]), access)


class _Server(uvicorn.Server):
    """A server whose signals are handled by its caller."""

    def capture_signals(self) -> Any:
        """Leave the signals alone."""
        return nullcontext()


async def _run(server: _Server, feed: RobotFeed, listener: socket.socket) -> None:
    """Serve until a signal, or until following the robot fails."""

    def end() -> None:
        server.should_exit = True

    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            loop.add_signal_handler(number, end)
    following = asyncio.create_task(feed.run())
    following.add_done_callback(lambda _: end())
    await server.serve([listener])
    following.cancel()
    with suppress(asyncio.CancelledError):
        await following


def _uvicorn_config(guard: Guard, settings: WebSettings) -> uvicorn.Config:
    certificate, key = settings.tls or (None, None)
    for option, path in (("--tls-certificate", certificate), ("--tls-key", key)):
        if path is not None and not os.access(path, os.R_OK):
            raise OmnidError(f"{option} {path}: cannot be read; name a PEM file")
    config = uvicorn.Config(
        guard,
        loop="asyncio",
        http="h11",
        ws="none",
        interface="asgi3",
        lifespan="off",
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
        listener = socket.create_server(address[:2], family=family, backlog=socket.SOMAXCONN)
    except OSError as error:
        raise OmnidError(
            f"--listen {listen}: {error.strerror or error}; stop the other program there, or name another address"
        ) from error
    with listener:
        # Connections of phones that have left the network end at some time; accepted sockets inherit it.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        yield listener


def _address(host: str) -> str:
    """Return the host for an address that browsers elsewhere can open."""
    if host in ("0.0.0.0", "::"):
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((_ELSEWHERE, 9))  # chooses the interface, sends nothing
            return str(probe.getsockname()[0])
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host
