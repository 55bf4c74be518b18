"""Access to the page: two tokens, and protection against requests that other sites make a browser send.

Any site that is open in the same browser may send requests here, or let its own name point to this address (DNS
rebinding). So a request must name a host of this server, come from a page of this server or from no
page, and carry a token: as `Authorization: Bearer TOKEN`, or as the cookie that a browser gets for the token.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import re
import secrets
from collections import Counter
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, NamedTuple

from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse

from omnid.errors import OmnidError

OPEN_PATHS: Final = ("/", "/login", "/static/login.css")  # answered without a token
# Letters that are not mistaken for others, because a phone's user types them.
_ALPHABET: Final = "abcdefghjkmnpqrstuvwxyz23456789"
_TOKEN: Final = re.compile(r"[!-~]{16,256}")
_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:\d{1,5})?")
_STOPPING: Final = ("/stop", "/logout")  # addresses to which the token for stops may post
_HEADERS: Final = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        b"form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    ),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),  # with no-referrer browsers hide the origin of the page's own requests
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


class Refusal(NamedTuple):
    """A request that is not answered; the reason is counted, the text is shown."""

    status: int
    reason: str
    text: str


_UNKNOWN_HOST: Final = Refusal(
    403,
    "unknown host",
    "this server is not known by that name: start omnid web with --host NAME, or use its address",
)
_OTHER_SITE: Final = Refusal(403, "cross-site", "requests of other sites are refused")
_NO_ORIGIN: Final = Refusal(
    403,
    "no origin",
    "a request that changes something needs the header Origin of this page, or Authorization: Bearer TOKEN",
)
_NO_TOKEN: Final = Refusal(401, "no token", "a token is needed: open the address that `omnid web` printed")
_WRONG_TOKEN: Final = Refusal(401, "wrong token", "the token is not that of this server")
_STOP_ONLY: Final = Refusal(403, "stop only", "this token may see and stop, nothing else")


class Role(StrEnum):
    """Rights of a token."""

    DRIVE = "drive"
    STOP = "stop"  # may see and stop


def new_token() -> str:
    """Return a random token of letters and digits in groups."""
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(5)) for _ in range(4))


def token_of(path: Path | None, option: str = "--token-file") -> str:
    """Return the token in a file, which is made if it is missing; without a file a new token. option: its name.

    Raise OmnidError for a file that cannot be used, or that every user of this machine may read.
    """
    if path is None:
        return new_token()
    try:
        try:
            number = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600)
        except FileExistsError:
            mode, text = path.stat().st_mode, path.read_text("ascii", "replace").strip()
        else:
            mode, text = 0o600, new_token()
            with os.fdopen(number, "w", encoding="ascii") as file:
                file.write(f"{text}\n")
    except OSError as error:
        raise OmnidError(f"{option} {path}: cannot be used: {error.strerror}; name another file") from error
    if mode & 0o007:
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

    def role_of(self, text: str) -> Role | None:
        """Return the role of a token, None for any other text; takes the same time for all texts."""
        return self._matching(text, lambda token: token)

    def new_cookie(self, role: Role) -> str:
        """Return the value of the cookie of a browser that knew a token, valid as long as the token."""
        return _proof(self.token if role is Role.DRIVE else self.stop_token)

    def role(self, request: HTTPConnection) -> Role | None:
        """Return what the token or the cookie of a request allows; None without one."""
        if "authorization" in request.headers:
            scheme, _, token = request.headers["authorization"].partition(" ")
            return self.role_of(token) if scheme.lower() == "bearer" else None
        return self._matching(request.cookies.get(self.cookie, ""), _proof)

    def refusal(self, request: HTTPConnection) -> Refusal | None:
        """Return the reason not to answer a request; None to answer it."""
        headers, host, path = request.headers, request.headers.get("host", ""), request.scope["path"]
        reads = request.scope["method"] in ("GET", "HEAD")
        # 1. DNS rebinding: the name must be one of this server.
        if not self._is_host(host):
            return _UNKNOWN_HOST
        # 2. Other sites: a page of theirs may only link to the first page, and no site can set Authorization.
        if "origin" in headers and headers["origin"].lower() not in (
            f"http://{host.lower()}",
            f"https://{host.lower()}",
        ):
            return _OTHER_SITE
        if not reads and "origin" not in headers and "authorization" not in headers:
            return _NO_ORIGIN
        if is_of_other_site(request) and not (reads and path == "/"):
            return _OTHER_SITE
        # 3. The token, except for the form that asks for it.
        if path in OPEN_PATHS:
            return None
        role = self.role(request)
        if role is None:
            return _WRONG_TOKEN if "authorization" in headers or self.cookie in request.cookies else _NO_TOKEN
        if role is Role.STOP and not reads and path not in _STOPPING:
            return _STOP_ONLY
        return None

    def _matching(self, given: str, proof: Callable[[str], str]) -> Role | None:
        found = None
        for role, token in ((Role.STOP, self.stop_token), (Role.DRIVE, self.token)):
            if hmac.compare_digest(given.strip().encode("utf-8", "replace"), proof(token).encode()) and token:
                found = role
        return found

    def _is_host(self, host: str) -> bool:
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        name = found[1].lower()
        return name in self.hosts or (self.any_address and _is_address(name.strip("[]")))


def is_of_other_site(request: HTTPConnection) -> bool:
    """True if a browser says that a page of another site, or of another port, has caused the request."""
    return request.headers.get("sec-fetch-site") in ("cross-site", "same-site")


def _proof(token: str) -> str:
    return hmac.new(token.encode(), b"omnid web cookie", hashlib.sha256).hexdigest()


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


class Guard:
    """ASGI middleware: refuses what may not enter, and adds the headers that protect the page.

    refused: number of refused requests by reason.
    """

    def __init__(self, app: App, access: Access) -> None:
        self._app, self._access = app, access
        self.refused: Counter[str] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""

        async def send_protected(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *_HEADERS]
            await send(message)

        refusal = self._access.refusal(HTTPConnection(scope))
        if refusal is None:
            await self._app(scope, receive, send_protected)
            return
        self.refused[refusal.reason] += 1
        answer = PlainTextResponse(f"omnid web: {refusal.text}\n", refusal.status, {"connection": "close"})
        await answer(scope, receive, send_protected)
