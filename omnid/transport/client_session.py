"""Sessions of programs that listen to robots and command them."""

from __future__ import annotations

import time
from typing import Final

import zenoh

from omnid.plain_text import plain
from omnid.transport.bus_config import BusConfig, checked
from omnid.transport.namesakes import ALIVE
from omnid.transport.session import Unreachable, open_session

HERE: Final = "tcp/127.0.0.1:7447"
_MAX_RETRY_S: Final = 0.5
_NAMED: Final = 5  # Most robots that a message names.
_ALIVE_TIMEOUT_S: Final = 1.0


def open_client(given: BusConfig, timeout_s: float = 0.0) -> zenoh.Session:
    """Open a session in client mode: peers that only share a router exchange no messages, clients do.

    Raise Unreachable where no endpoint answers within timeout_s, OmnidError for wrong settings.
    """
    chosen = {
        name: getattr(given, name)
        for name in (
            "robot",
            "connect",
            "config",
            "retry_s",
            "tls_ca",
            "tls_connect_key",
            "tls_connect_certificate",
            "user",
            "password_file",
        )
    }
    config = checked(BusConfig(mode="client", listen=(), **{**chosen, "connect": given.connect or (HERE,)}))
    deadline_s = time.monotonic() + timeout_s
    while True:
        try:
            return open_session(config, guarded=False)
        except Unreachable:
            if time.monotonic() >= deadline_s:
                raise
        time.sleep(min(config.retry_s, _MAX_RETRY_S))


def robots_there(session: zenoh.Session) -> str:
    """Return the names of the robots that this session reaches, as a part of a sentence."""
    replies = session.liveliness().get(f"**/{ALIVE}", timeout=_ALIVE_TIMEOUT_S)
    names = sorted(str(reply.ok.key_expr).rpartition("/")[0] for reply in replies if reply.ok is not None)
    more = [f"{len(names) - _NAMED} more"] if len(names) > _NAMED else []
    return plain(f"robots there: {', '.join([*names[:_NAMED], *more])}") if names else "no robot is there"
