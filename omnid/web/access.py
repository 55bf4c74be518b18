"""Access to the page: the token, and protection against requests that other sites make a browser send.

Any site that is open in the same browser may send requests here, open a websocket here, or let its own name point to
this address (DNS rebinding). So a request must name a host of this server, come from a page of this server or from no
page, and carry the token: as `Authorization: Bearer TOKEN`, or as the cookie that a browser gets for the token.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import re
import secrets
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, NamedTuple

from omnid.errors import OmnidError

OPEN_PATHS: Final = ("/", "/login", "/static/login.css")  # answered without the token
# Letters that are not mistaken for others, because a phone's user types them.
_ALPHABET: Final = "abcdefghjkmnpqrstuvwxyz23456789"
_GROUPS, _GROUP_LETTERS = 4, 5  # 99 bits
_TOKEN: Final = re.compile(r"[!-~]{16,256}")
_MAX_FILE_BYTES: Final = 4096
_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:\d{1,5})?")
_OTHER_SITES: Final = ("cross-site", "same-site")
_READING: Final = ("GET", "HEAD")
_STOPPING: Final = ("stop", "logout")  # last parts of the addresses to which the token for stops may post
COOKIE_S: Final = 30 * 86_400  # A browser keeps the cookie for this time.
MOST_ENDED: Final = 1000  # sessions
_COOKIE: Final = re.compile(
    r"(?P<id>[0-9a-f]{16})\.(?P<role>all|stop)\.(?P<end_s>[0-9]{1,12})\."
    r"(?P<proof>[0-9a-f]{64})"
)


class Refusal(NamedTuple):
    """A request that is not answered; the reason is counted, the text is shown."""

    status: int
    reason: str
    text: str


_NO_TOKEN: Final = Refusal(401, "no token", "a token is needed: open the address that `omnid web` printed")
_WRONG_TOKEN: Final = Refusal(401, "wrong token", "the token is not that of this server")
_STOP_ONLY: Final = Refusal(403, "stop only", "this token may see and stop, nothing else")
_OTHER_ORIGIN: Final = Refusal(403, "cross-site", "requests of other sites are refused")
_NO_ORIGIN: Final = Refusal(
    403,
    "no origin",
    "a request that changes something needs the header Origin of this page, or Authorization: Bearer TOKEN",
)


class Role(StrEnum):
    """Rights of a token."""

    ALL = "all"
    STOP = "stop"  # may see and stop


def new_token() -> str:
    """Return a random token of letters and digits in groups."""
    letters = [secrets.choice(_ALPHABET) for _ in range(_GROUPS * _GROUP_LETTERS)]
    return "-".join("".join(letters[i::_GROUPS]) for i in range(_GROUPS))


def token_of(path: Path | None, option: str = "--token-file") -> str:
    """Return the token in a file, which is made if it is missing; without a file a new token. option: its name.

    Raise OmnidError for a file that cannot be used, or that every user of this machine may read.
    """
    if path is None:
        return new_token()
    try:
        number = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        return _read_token(path, option)
    except OSError as error:
        raise OmnidError(f"{option} {path}: cannot be made: {error.strerror}; name another file") from error
    token = new_token()
    with os.fdopen(number, "w", encoding="ascii") as file:
        file.write(f"{token}\n")
    return token


def _read_token(path: Path, option: str) -> str:
    try:
        with path.open("rb") as file:
            mode, data = os.fstat(file.fileno()).st_mode, file.read(_MAX_FILE_BYTES)
    except OSError as error:
        raise OmnidError(f"{option} {path}: cannot be read: {error.strerror}; name another file") from error
    if mode & 0o007:
        raise OmnidError(f"{option} {path}: every user of this machine may read or write it: chmod 600 {path}")
    text = data.decode("ascii", "replace").strip()
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
    _ended: dict[str, None] = field(default_factory=dict)  # sessions that were ended, the newest last

    def new_cookie(self, role: Role) -> str:
        """Return the value of the cookie of a browser that knew a token: a session, its role, its end, and a proof.

        It is valid for COOKIE_S, as long as the token, and until the session is ended.
        """
        content = f"{secrets.token_hex(8)}.{role}.{round(time.time()) + COOKIE_S}"
        return f"{content}.{self._proof(content, role)}"

    def end_session(self, scope: Mapping[str, Any]) -> None:
        """Refuse the cookies of a request from now on; the newest MOST_ENDED are remembered until the next start."""
        for name, value in _Headers(scope["headers"]).cookies():
            if name == self.cookie and self._role_of_cookie(value) is not None:
                self._ended[value.partition(".")[0]] = None
        while len(self._ended) > MOST_ENDED:
            del self._ended[next(iter(self._ended))]

    def role_of(self, text: str) -> Role | None:
        """Return the role of a token, None for any other text; takes the same time for all texts."""
        given = text.strip().encode("utf-8", "replace")
        is_all = hmac.compare_digest(given, self.token.encode())
        is_stop = hmac.compare_digest(given, self.stop_token.encode()) and bool(self.stop_token)
        if is_all:
            return Role.ALL
        return Role.STOP if is_stop else None

    def _proof(self, content: str, role: Role) -> str:
        key = self.token if role is Role.ALL else self.stop_token
        return hmac.new(key.encode(), f"omnid web cookie {content}".encode(), hashlib.sha256).hexdigest()

    def _role_of_cookie(self, value: str) -> Role | None:
        found = _COOKIE.fullmatch(value)
        if found is None or (found["role"] == Role.STOP and not self.stop_token):
            return None
        role, content = Role(found["role"]), value.rpartition(".")[0]
        if not hmac.compare_digest(found["proof"].encode(), self._proof(content, role).encode()):
            return None
        return role if int(found["end_s"]) > time.time() and found["id"] not in self._ended else None

    def refusal(self, scope: Mapping[str, Any]) -> Refusal | None:
        """Return the reason not to answer a request (ASGI scope of http or websocket); None to answer it."""
        headers = _Headers(scope["headers"])
        host = headers.only("host")
        if not self._is_host(host):
            return Refusal(
                403,
                "unknown host",
                "this server is not known by that name: start omnid web with --host NAME, or use its address",
            )
        fault = self._other_site(scope, headers, host)
        if fault is None and not self._is_open(scope):
            fault = self._token_fault(scope, headers)
        return fault

    def has_token(self, scope: Mapping[str, Any]) -> bool:
        """True if the request carries the token or the cookie."""
        return self._role(_Headers(scope["headers"])) is not None

    def _is_host(self, host: str) -> bool:
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        name = found[1].lower()
        return name in self.hosts or (self.any_address and _is_address(name.strip("[]")))

    def _other_site(self, scope: Mapping[str, Any], headers: _Headers, host: str) -> Refusal | None:
        """Return the refusal of a request that a page of another site caused."""
        reading = scope["type"] == "http" and scope["method"] in _READING
        if headers.has("origin"):
            if headers.only("origin").lower() not in (f"http://{host.lower()}", f"https://{host.lower()}"):
                return _OTHER_ORIGIN
        elif not reading and not headers.has("authorization"):  # which no other site can make a browser send
            return _NO_ORIGIN
        opened = reading and scope["path"] == "/" and headers.only("sec-fetch-mode") == "navigate"  # a followed link
        if headers.only("sec-fetch-site") in _OTHER_SITES and not opened:
            return _OTHER_ORIGIN
        return None

    def _is_open(self, scope: Mapping[str, Any]) -> bool:
        return scope["type"] == "http" and scope["path"] in OPEN_PATHS

    def _role(self, headers: _Headers) -> Role | None:
        """Return what the token or the cookie of a request allows."""
        if headers.has("authorization"):
            scheme, _, token = headers.only("authorization").partition(" ")
            return self.role_of(token) if scheme.lower() == "bearer" else None
        roles = [self._role_of_cookie(value) for name, value in headers.cookies() if name == self.cookie]
        return max(filter(None, roles), key=lambda role: role is Role.ALL, default=None)

    def _token_fault(self, scope: Mapping[str, Any], headers: _Headers) -> Refusal | None:
        role = self._role(headers)
        if role is None:
            given = headers.has("authorization") or any(name == self.cookie for name, _ in headers.cookies())
            return _WRONG_TOKEN if given else _NO_TOKEN
        if role is Role.ALL or scope["type"] == "websocket" or scope["method"] in _READING:
            return None
        return None if scope["path"].rpartition("/")[2] in _STOPPING else _STOP_ONLY


class _Headers:
    """Headers of an ASGI scope."""

    def __init__(self, headers: Iterable[tuple[bytes, bytes]]) -> None:
        self._values: dict[str, list[str]] = {}
        for name, value in headers:
            self._values.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1").strip())

    def has(self, name: str) -> bool:
        """True if the header is there."""
        return name in self._values

    def only(self, name: str) -> str:
        """Return the value of a header that is there once; else an empty text, which no rule accepts."""
        values = self._values.get(name, [])
        return values[0] if len(values) == 1 else ""

    def cookies(self) -> list[tuple[str, str]]:
        """Return names and values of all cookies."""
        pairs = (pair.strip().partition("=") for value in self._values.get("cookie", []) for pair in value.split(";"))
        return [(name, value) for name, _, value in pairs]


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
