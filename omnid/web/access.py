"""Access to the page: two tokens, and protection against requests that other sites make a browser send.

Any site that is open in the same browser may send requests here, or let its own name point to this address (DNS
rebinding). So a request must name a host of this server, come from a page of this server or from no
page, and carry a token: as `Authorization: Bearer TOKEN`, or as a cookie.
"""

from __future__ import annotations

import hmac
import ipaddress
import os
import re
import secrets
import stat
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from http import HTTPStatus
from pathlib import Path
from typing import Final

from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from omnid.errors import OmnidError

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
            number = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600)
            with os.fdopen(number, "w", encoding="ascii") as file:
                file.write(f"{made}\n")
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
        if is_of_other_site(request) and not (reads and path == "/"):
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


def is_of_other_site(request: HTTPConnection) -> bool:
    """True if a browser says that a page of another site, or of another port, has caused the request."""
    return request.headers.get("sec-fetch-site") in ("cross-site", "same-site")


class Guard:
    """ASGI middleware: refuses what may not enter, and adds the headers that protect the page."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""

        async def send_protected(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *_HEADERS]
            await send(message)

        app, reason = self._app, self._access.refusal(HTTPConnection(scope))
        if reason:
            status = HTTPStatus.UNAUTHORIZED if " token:" in reason else HTTPStatus.FORBIDDEN
            app = PlainTextResponse(f"omnid web: {reason}\n", status, {"connection": "close"})
        await app(scope, receive, send_protected)
