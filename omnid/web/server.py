"""The server of the page: who may enter, its names and its cookie, its start and its end.

There are two tokens, and protection against requests that other sites make a browser send. Any site that is open in the
same browser may send requests here, or let its own name point to this address (DNS rebinding). So a request must name a
host of this server, come from a page of this server or from no page, and carry a token: as `Authorization: Bearer
TOKEN`, or as a cookie.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import json
import logging
import re
import secrets
import socket
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from http import HTTPStatus
from pathlib import Path
from typing import Final

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from omnid.engine.logging_setup import is_journal, log
from omnid.engine.process import handle_stop_signals
from omnid.errors import OmnidError
from omnid.monitor.robot_state import RobotState
from omnid.transport.session import BusConfig
from omnid.transport.status_names import number, short_name
from omnid.web.feed import RobotFeed
from omnid.web.robot import RobotPage

STATIC: Final = Path(__file__).with_name("static")
COOKIE_S: Final = 30 * 86_400  # A browser keeps the cookie for this time.
_ELSEWHERE: Final = "192.0.2.1"  # an address of documentation (RFC 5737); nothing is sent there
_TOKEN: Final = re.compile(r"[!-~]{16,256}")
_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:\d{1,5})?")
_HEADERS: Final = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        b"form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),  # with no-referrer browsers hide the origin of the page's own requests
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)
NO_TOKEN: Final = "no token: open the address that `omnid web` printed"


# 1. Who may enter.
class Role(StrEnum):
    """Rights of a token."""

    DRIVE = "drive"
    STOP = "stop"  # may see and stop


def token_of(path: Path | None, option: str = "--token-file") -> str:
    """Return the token in a file, which is made if it is missing; without a file a new token. option: its name.

    A new one has no letters that are mistaken for others, because a phone's user types them.

    Raise OmnidError for a file that cannot be used, or that every user of this machine may read.
    """
    made = "-".join("".join(secrets.choice("abcdefghjkmnpqrstuvwxyz23456789") for _ in range(5)) for _ in range(4))
    if path is None:
        return made
    try:
        with suppress(FileExistsError):
            path.touch(0o600, exist_ok=False)
            path.write_text(f"{made}\n", "ascii")
        mode, text = path.stat().st_mode, path.read_text("ascii", "replace").strip()
    except OSError as error:
        raise OmnidError(f"{option} {path}: cannot be used: {error.strerror}; name another file") from error
    if mode & stat.S_IRWXO:
        raise OmnidError(f"{option} {path}: every user of this machine may read or write it: chmod 600 {path}")
    if not _TOKEN.fullmatch(text):
        raise OmnidError(
            f"{option} {path}: expected one line of 16 to 256 letters without spaces; delete the file to have one made"
        )
    return text


@dataclass(frozen=True, slots=True)
class Access:
    """Decides which requests are answered.

    hosts: names in lower case by which this server is reached. any_address: True if it is also reached by IP
    addresses: a name that an attacker controls is none of these. cookie: its name, with the port, because browsers
    send the cookies of one port to all ports of a host. stop_token: a token that may see and stop only; "": none.
    """

    token: str
    hosts: frozenset[str]
    any_address: bool
    cookie: str
    stop_token: str = ""

    def role_of(self, given: str) -> Role | None:
        """Return the role of a token; None for any other text, after the same time."""
        found = None
        for role, token in ((Role.STOP, self.stop_token), (Role.DRIVE, self.token)):
            if hmac.compare_digest(given.strip().encode("utf-8", "replace"), token.encode()) and token:
                found = role
        return found

    def role(self, request: HTTPConnection) -> Role | None:
        """Return what the token or the cookie of a request allows; None without one."""
        if "authorization" in request.headers:
            scheme, _, token = request.headers["authorization"].partition(" ")
            return self.role_of(token) if scheme.lower() == "bearer" else None
        return self.role_of(request.cookies.get(self.cookie, ""))

    def refusal(self, request: HTTPConnection) -> str:
        """Return why a request is not answered; "" to answer it."""
        headers, host, path = request.headers, request.headers.get("host", ""), request.scope["path"]
        reads, has_token = request.scope["method"] in ("GET", "HEAD"), "authorization" in headers
        # 1. DNS rebinding: the name must be one of this server.
        if not self._is_host(host):
            return "unknown host: this server is called otherwise; start omnid web with --host NAME, or use its address"
        # 2. Other sites: a page of theirs may only link to the first page, and no site can set Authorization.
        other_site = "cross-site: requests of other sites are refused"
        own = (f"http://{host.lower()}", f"https://{host.lower()}")
        if headers.get("origin", own[0]).lower() not in own:
            return other_site
        if not reads and "origin" not in headers and not has_token:
            return "no origin: a change needs the header Origin of this page, or Authorization: Bearer TOKEN"
        if headers.get("sec-fetch-site") in ("cross-site", "same-site") and not (reads and path == "/"):
            return other_site
        # 3. The token, except at the address that takes it.
        if path == "/":
            return ""
        role = self.role(request)
        if role is None:
            given = has_token or self.cookie in request.cookies
            return "wrong token: it is not that of this server" if given else NO_TOKEN
        stop_only = role is Role.STOP and not reads and path != "/stop"
        return "stop only: this token may see and stop, nothing else" if stop_only else ""

    def _is_host(self, host: str) -> bool:
        found = _HOST.fullmatch(host)
        name = found[1].lower() if found else ""
        with suppress(ValueError):
            return name in self.hosts or (self.any_address and bool(ipaddress.ip_address(name.strip("[]"))))
        return False

    def guarding(self, app: ASGIApp) -> ASGIApp:
        """Return ASGI middleware that refuses what may not enter, and adds the headers that protect the page."""

        async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
            async def send_protected(message: Message) -> None:
                if message["type"] == "http.response.start":
                    message["headers"] = [*message.get("headers", []), *_HEADERS]
                await send(message)

            if reason := self.refusal(HTTPConnection(scope)):
                status = HTTPStatus.UNAUTHORIZED if " token:" in reason else HTTPStatus.FORBIDDEN
                refused = PlainTextResponse(f"omnid web: {reason}\n", status, {"connection": "close"})
                await refused(scope, receive, send_protected)
            else:
                await app(scope, receive, send_protected)

        return guarded


# 2. The server.
def serve(
    bus: BusConfig, listen: str, token_file: Path | None, stop_token_file: Path | None, names: Sequence[str]
) -> None:
    """Serve the page until SIGINT or SIGTERM. Raise OmnidError for settings that cannot be used.

    listen: HOST:PORT; port 0: any. token_file: None: a new token. stop_token_file: of a second token, which may see and
    stop but not arm. names: further names of this machine.
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
        is_local, name = ipaddress.ip_address(host).is_loopback, socket.gethostname()
        own = ("localhost", "127.0.0.1", "[::1]") if is_local else ("localhost", name, f"{name}.local")
        hosts = frozenset(name.lower() for name in (*own, *names))
        access = Access(token, hosts, not is_local, f"omnid_{port}", stop_token)
        page = RobotPage(RobotFeed(bus))
        config = uvicorn.Config(
            access.guarding(site(page, access)),
            lifespan="off",
            log_config=None,
            access_log=False,
            proxy_headers=False,
            server_header=False,
            ws="none",  # else uvicorn would pass websockets on, or advise a library for them
            timeout_graceful_shutdown=1,
        )
        # 3. Print where it is; with the tokens, unless the journal would keep them.
        url = f"http://{_address(host)}:{port}/"
        lines = [f"{url}?token={token}"] + [f"{url}?token={stop_token} (may see and stop, not arm)"] * bool(stop_token)
        shown = [f"{url} (the token is in the file of --token-file)"] if is_journal(sys.stdout) else lines
        print(*shown, sep="\n", flush=True)
        if not is_local:
            log(
                logging.WARNING,
                "the page can be reached from the network without encryption: everyone who can listen there learns the "
                "token, and may arm the robot; use a network that you trust, `ssh -L`, or a reverse proxy with TLS",
            )
        # 4. Serve. uvicorn ends at a signal, and raises it again for the handlers that were set before: they ignore it.
        with handle_stop_signals(lambda *_: None):
            asyncio.run(_run(uvicorn.Server(config), page.feed, listener))


def site(page: RobotPage, access: Access) -> Starlette:
    """Return the server's application."""

    async def index(request: Request) -> Response:
        """Return the page; let a browser in that names the token."""
        token = request.query_params.get("token")
        if token is not None and access.role_of(token) is not None:
            response = RedirectResponse("/", HTTPStatus.SEE_OTHER)
            # Lax: a link of another site brings the cookie along, any other request of it does not.
            response.set_cookie(access.cookie, token, COOKIE_S, httponly=True, samesite="lax")
            return response
        if token is None and access.role(request) is not None:
            return FileResponse(STATIC / "index.html")
        return PlainTextResponse(f"omnid web: {NO_TOKEN}\n", HTTPStatus.UNAUTHORIZED)

    async def numbers(_: Request) -> Response:
        return PlainTextResponse(metrics(page.feed.state), media_type="text/plain; version=0.0.4")

    files = Mount("/static", StaticFiles(directory=STATIC))
    return Starlette(routes=[Route("/", index), Route("/metrics", numbers), files, *page.routes()])


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
        name = f"part={json.dumps(short_name(part.name), ensure_ascii=False)}"
        found.setdefault(f"omnid_status_level{{{name}}}", part.level)
        for key, text in part.values.items():
            if (value := number(text)) is not None:
                label = f"key={json.dumps(key, ensure_ascii=False)}"
                found.setdefault(f"omnid_status_value{{{name},{label}}}", value)
    return "".join(f"{sample} {float(value)}\n" for sample, value in sorted(found.items()))


async def _run(server: uvicorn.Server, feed: RobotFeed, listener: socket.socket) -> None:
    """Serve until a signal, or until following the robot fails."""
    following = asyncio.create_task(feed.run())
    following.add_done_callback(lambda _: setattr(server, "should_exit", True))
    await server.serve([listener])
    following.cancel()
    with suppress(asyncio.CancelledError):
        await following


@contextmanager
def _listening(listen: str) -> Iterator[socket.socket]:
    """Yield a socket that listens on HOST:PORT. Raise OmnidError where that cannot be."""
    host, _, port = listen.rpartition(":")
    try:
        family, _, _, _, address = socket.getaddrinfo(host.strip("[]"), None, type=socket.SOCK_STREAM)[0]
        listener = socket.create_server((address[0], int(port)), family=family, backlog=socket.SOMAXCONN)
    except (OSError, ValueError, OverflowError) as error:
        raise OmnidError(
            f"--listen {listen}: {error}; expected HOST:PORT with a free port, such as 127.0.0.1:8447, or 0.0.0.0:8447 "
            "for the network"
        ) from error
    with listener:
        yield listener


def _address(host: str) -> str:
    """Return the host for an address that browsers elsewhere can open."""
    if host in ("0.0.0.0", "::"):
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((_ELSEWHERE, 9))  # chooses the interface, sends nothing
            return str(probe.getsockname()[0])
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host
