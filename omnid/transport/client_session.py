"""Sessions of programs that listen to robots and command them."""

from __future__ import annotations

import time
from typing import Final

import zenoh

from omnid.transport.bus_config import BusConfig, checked
from omnid.transport.session import Unreachable, open_session

HERE: Final = "tcp/127.0.0.1:7447"
_MAX_RETRY_S: Final = 0.5


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
