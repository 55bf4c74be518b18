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
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from omnid.errors import OmnidError

OPEN_PATHS: Final = ("/", "/login", "/static/login.css")  # answered without the token
_ALPHABET: Final = "abcdefghjkmnpqrstuvwxyz23456789"  # without letters that look alike: a phone's user types them
_GROUPS, _GROUP_LETTERS = 4, 5  # 99 bits
_TOKEN: Final = re.compile(r"[!-~]{16,256}")
_MAX_FILE_BYTES: Final = 4096
_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:\d{1,5})?")
_OTHER_SITES: Final = ("cross-site", "same-site")
_READING: Final = ("GET", "HEAD")


class Refusal(NamedTuple):
    """A request that is not answered; the reason is counted, the text is shown."""

    status: int
    reason: str
    text: str


_NO_TOKEN: Final = Refusal(401, "no token", "a token is needed: open the address that `omnid web` printed")
_WRONG_TOKEN: Final = Refusal(401, "wrong token", "the token is not that of this server")
_OTHER_ORIGIN: Final = Refusal(403, "cross-site", "requests of other sites are refused")
_NO_ORIGIN: Final = Refusal(403, "no origin", "a request that changes something needs the header Origin of this page, "
                            "or Authorization: Bearer TOKEN")


def new_token() -> str:
    """Return a random token of letters and digits in groups."""
    letters = [secrets.choice(_ALPHABET) for _ in range(_GROUPS * _GROUP_LETTERS)]
    return "-".join("".join(letters[i::_GROUPS]) for i in range(_GROUPS))


def token_of(path: Path | None) -> str:
    """Return the token in a file, which is made if it is missing; without a file a new token.

    Raise OmnidError for a file that cannot be used, or that every user of this machine may read.
    """
    if path is None:
        return new_token()
    try:
        number = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        return _read_token(path)
    except OSError as error:
        raise OmnidError(f"--token-file {path}: cannot be made: {error.strerror}; name another file") from error
    token = new_token()
    with os.fdopen(number, "w", encoding="ascii") as file:
        file.write(f"{token}\n")
    return token


def _read_token(path: Path) -> str:
    try:
        with path.open("rb") as file:
            mode, data = os.fstat(file.fileno()).st_mode, file.read(_MAX_FILE_BYTES)
    except OSError as error:
        raise OmnidError(f"--token-file {path}: cannot be read: {error.strerror}; name another file") from error
    if mode & 0o007:
        raise OmnidError(f"--token-file {path}: every user of this machine may read or write it: chmod 600 {path}")
    text = data.decode("ascii", "replace").strip()
    if not _TOKEN.fullmatch(text):
        raise OmnidError(f"--token-file {path}: expected one line of 16 to 256 letters without spaces; delete the file "
                         "to have one made")
    return text


@dataclass(frozen=True, slots=True)
class Access:
    """Decides which requests are answered.

    hosts: names in lower case by which this server is reached. any_address: True if it is also reached by IP
    addresses: a name that an attacker controls is none of these. cookie: its name, with the port, because browsers
    send the cookies of one port to all ports of a host.
    """

    token: str
    hosts: frozenset[str]
    any_address: bool
    cookie: str

    @property
    def cookie_value(self) -> str:
        """The value of the cookie of a browser that knew the token; it is valid as long as the token."""
        return hmac.new(self.token.encode(), b"omnid web cookie", hashlib.sha256).hexdigest()

    def is_token(self, text: str) -> bool:
        """True if the text is the token; takes the same time for all texts."""
        return hmac.compare_digest(text.strip().encode("utf-8", "replace"), self.token.encode())

    def refusal(self, scope: Mapping[str, Any]) -> Refusal | None:
        """Return the reason not to answer a request (ASGI scope of http or websocket); None to answer it."""
        headers = _Headers(scope["headers"])
        host = headers.only("host")
        if not self._is_host(host):
            return Refusal(403, "unknown host", "this server is not known by that name: start omnid web with --host "
                           "NAME, or use its address")
        fault = self._other_site(scope, headers, host)
        if fault is None and not self._is_open(scope):
            fault = self._token_fault(headers)
        return fault

    def has_token(self, scope: Mapping[str, Any]) -> bool:
        """True if the request carries the token or the cookie."""
        return self._token_fault(_Headers(scope["headers"])) is None

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

    def _is_bearer(self, headers: _Headers) -> bool:
        scheme, _, token = headers.only("authorization").partition(" ")
        return scheme.lower() == "bearer" and self.is_token(token)

    def _token_fault(self, headers: _Headers) -> Refusal | None:
        if headers.has("authorization"):
            return None if self._is_bearer(headers) else _WRONG_TOKEN
        values = [value for name, value in headers.cookies() if name == self.cookie]
        if not values:
            return _NO_TOKEN
        known = [hmac.compare_digest(value.encode(), self.cookie_value.encode()) for value in values]
        return None if any(known) else _WRONG_TOKEN


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
