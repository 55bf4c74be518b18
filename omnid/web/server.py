"""The server: the names by which it may be called, the cookie for the token, its start and its end."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import logging
import re
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from typing import Final

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from omnid.engine.logging_setup import is_journal, log
from omnid.engine.process import handle_stop_signals
from omnid.errors import OmnidError
from omnid.monitor.robot_state import RobotState
from omnid.plain_text import MOST_ENTRIES, plain
from omnid.transport.session import BusConfig
from omnid.transport.status_names import number, short_name
from omnid.web.access import NO_TOKEN, Access, Guard, is_of_other_site, token_of
from omnid.web.feed import RobotFeed
from omnid.web.robot import RobotPage

DEFAULT_LISTEN: Final = "127.0.0.1:8447"
STATIC: Final = Path(__file__).with_name("static")
COOKIE_S: Final = 30 * 86_400  # A browser keeps the cookie for this time.
# A link of another site brings no cookie along (SameSite=Strict); a page that loads itself again does.
_AGAIN: Final = '<!DOCTYPE html><title>omnid</title><meta http-equiv="refresh" content="0">'
_LISTEN: Final = re.compile(r"(\[[0-9A-Fa-f:.%]+\]|[A-Za-z0-9._-]+):(\d{1,5})")
_ELSEWHERE: Final = "192.0.2.1"  # an address of documentation (RFC 5737); nothing is sent there


def serve(
    bus: BusConfig,
    *,
    listen: str,
    token_file: Path | None = None,
    stop_token_file: Path | None = None,
    names: tuple[str, ...] = (),
    tls: tuple[Path, Path] | None = None,
) -> None:
    """Serve the page until SIGINT or SIGTERM. Raise OmnidError for settings that cannot be used.

    listen: HOST:PORT; port 0: any. stop_token_file: of a second token, which may see and stop but not arm. names:
    further names of this machine. tls: certificate and key, PEM.
    """
    # 1. Read the tokens.
    token = token_of(token_file)
    stop_token = token_of(stop_token_file, "--stop-token-file") if stop_token_file else ""
    if token == stop_token:
        raise OmnidError("--stop-token-file has the token of --token-file, which may arm: name another file")
    if token_file is None and is_journal(sys.stdout):
        raise OmnidError("omnid web prints its token, and the journal would keep it: name a --token-file")
    with _listening(listen) as listener:
        # 2. Build the page.
        host, port = listener.getsockname()[:2]
        local = ipaddress.ip_address(host).is_loopback
        name = socket.gethostname()
        own = ("localhost", "127.0.0.1", "[::1]") if local else ("localhost", name, f"{name}.local")
        hosts = frozenset(name.lower() for name in (*own, *names))
        access = Access(token, hosts, not local, f"omnid_{port}", stop_token)
        page = RobotPage(RobotFeed(bus))
        server = uvicorn.Server(_uvicorn_config(site(page, access, secure=tls is not None), tls))
        # 3. Print where it is; with the tokens, unless the journal would keep them.
        url = f"{'https' if tls else 'http'}://{_address(host)}:{port}/"
        if is_journal(sys.stdout):
            print(f"{url} (the token is in the file of --token-file)", flush=True)
        else:
            print(f"{url}?token={token}", flush=True)
            if stop_token:
                print(f"{url}?token={stop_token} (may see and stop, not arm)", flush=True)
        if not local and tls is None:
            log(
                logging.WARNING,
                "the page can be reached from the network without encryption: everyone who can listen there learns the "
                "token, and may arm the robot; use --tls-certificate and --tls-key, or a network that you trust",
            )
        # 4. Serve. uvicorn ends by a signal, and sends it once more to the handlers of before.
        with handle_stop_signals(lambda *_: None):
            asyncio.run(_run(server, page.feed, listener))


def site(page: RobotPage, access: Access, *, secure: bool) -> Guard:
    """Return the server's application. secure: it speaks TLS, so that browsers send the cookie over TLS only."""

    async def index(request: Request) -> Response:
        """Return the page; let a browser in that names the token."""
        token = request.query_params.get("token")
        if token is not None and access.role_of(token) is not None:
            response = RedirectResponse("/", HTTPStatus.SEE_OTHER)
            response.set_cookie(access.cookie, token, COOKIE_S, httponly=True, samesite="strict", secure=secure)
            return response
        if token is None and access.role(request) is not None:
            return FileResponse(STATIC / "index.html")
        if token is None and is_of_other_site(request):
            return HTMLResponse(_AGAIN)
        return PlainTextResponse(f"omnid web: {NO_TOKEN}\n", HTTPStatus.UNAUTHORIZED)

    async def numbers(_: Request) -> Response:
        return PlainTextResponse(metrics(page.feed.state), media_type="text/plain; version=0.0.4")

    outer = [
        Route("/", index),
        Route("/metrics", numbers),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]
    return Guard(Starlette(routes=[*outer, *page.routes()]), access)


def metrics(state: RobotState) -> str:
    """Return the metrics for Prometheus: whether the robot is there, its poses, and every number of its status.

    JSON escapes the texts of labels as the format wants it. Of two equal labels the first one counts.
    """
    found: dict[str, float] = {
        "omnid_up": state.alive is True,
        "omnid_pose_rate_hz": state.rate_hz,
        "omnid_poses_total": state.poses,
        "omnid_poses_missed_total": state.missed,
    }
    for part in list(state.statuses.values()):
        name = f"part={json.dumps(plain(short_name(part.name)), ensure_ascii=False)}"
        found.setdefault(f"omnid_status_level{{{name}}}", part.level)
        for key, text in list(part.values.items())[:MOST_ENTRIES]:
            if (value := number(text)) is not None:
                label = json.dumps(plain(key), ensure_ascii=False)
                found.setdefault(f"omnid_status_value{{{name},key={label}}}", value)
    return "".join(f"{sample} {float(value)}\n" for sample, value in sorted(found.items()))


async def _run(server: uvicorn.Server, feed: RobotFeed, listener: socket.socket) -> None:
    """Serve until a signal, or until following the robot fails."""
    following = asyncio.create_task(feed.run())
    following.add_done_callback(lambda _: setattr(server, "should_exit", True))
    await server.serve([listener])
    following.cancel()
    with suppress(asyncio.CancelledError):
        await following


def _uvicorn_config(guard: Guard, tls: tuple[Path, Path] | None) -> uvicorn.Config:
    certificate, key = tls or (None, None)
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
        timeout_graceful_shutdown=1,
        ssl_certfile=certificate,
        ssl_keyfile=key,
    )
    try:
        config.load()
    except OSError as error:  # of ssl
        what = f"--tls-certificate {certificate}, --tls-key {key}: {error.strerror or error}"
        raise OmnidError(f"{what}; name a certificate and its key in PEM") from error
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
