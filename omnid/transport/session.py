"""Opens zenoh sessions as the configuration wants them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any, Final

import zenoh

from omnid.errors import OmnidError
from omnid.transport.access import access_control
from omnid.transport.bus_config import BusConfig, set_knobs, text_of

_SOURCE_LINE: Final = re.compile(r"\s+at /\S+\.rs:\d+\.?")
_TRY_MS: Final = 1000  # a client's try to reach its router; it opens no session without
_URGENT_BATCHES: Final = 16  # zenoh's own 2 are soon full on a busy host, and poses are dropped
_TLS: Final = {
    "tls_ca": "root_ca_certificate",
    "tls_listen_key": "listen_private_key",
    "tls_listen_certificate": "listen_certificate",
    "tls_connect_key": "connect_private_key",
    "tls_connect_certificate": "connect_certificate",
}


class Unreachable(OmnidError):  # noqa: N818 - it may be there in a moment
    """Nobody answers where a client is to connect to, or not to us."""


def open_session(config: BusConfig, *, guarded: bool = True) -> zenoh.Session:
    """A session; OmnidError where an endpoint cannot be listened on, or nobody answers a client (Unreachable).

    guarded: only commands may come in.
    """
    prepared = zenoh_config(config, guarded=guarded)
    try:
        return zenoh.open(prepared)
    except zenoh.ZError as error:
        raise _failure(config, reason(error)) from error


def _failure(config: BusConfig, why: str) -> OmnidError:
    if config.mode == "client":
        asked = ", ".join(config.connect)
        return Unreachable(f"bus cannot reach {asked}: {why}; start what listens there or change bus.connect")
    asked = ", ".join(config.listen)
    return OmnidError(f"bus cannot listen on {asked}: {why}; stop the other program there or change bus.listen")


def zenoh_config(config: BusConfig, *, guarded: bool = True) -> zenoh.Config:
    """zenoh's own configuration: its file, where there is one, ours where it says nothing, and all that is asked for.

    Not zenoh's defaults: those listen on all interfaces and shout for others. Shared memory only pays above 100 kB and
    leaves files behind.
    """
    answer, untouched, asked = _of_file(config), zenoh.Config(), set_knobs(config)
    for key, value, knob in _settings(config, guarded):
        if knob == "mode" or knob in asked or answer.get_json(key) == untouched.get_json(key):
            answer.insert_json5(key, json.dumps(value))
    return answer


def _of_file(config: BusConfig) -> zenoh.Config:
    if not config.config:
        return zenoh.Config()
    try:
        return zenoh.Config.from_json5(text_of(config, "config"))
    except zenoh.ZError as error:
        told = f"bus.config: {config.config!r} is no zenoh configuration: {reason(error)}; mend it"
        raise OmnidError(told) from error


def _settings(config: BusConfig, guarded: bool) -> Iterator[tuple[str, Any, str]]:
    """zenoh's key, the value, and the knob that asks for it."""
    client = config.mode == "client"
    yield "mode", config.mode, "mode"
    yield "listen/endpoints", [] if client else list(config.listen), "listen"
    yield "connect/endpoints", list(config.connect), "connect"
    yield "connect/exit_on_failure", client, ""
    yield "connect/retry", {"period_init_ms": min(500, round(1e3 * config.retry_s)),
                            "period_max_ms": round(1e3 * config.retry_s), "period_increase_factor": 2}, "retry_s"
    if client:
        yield "connect/timeout_ms", _TRY_MS, ""
    yield "scouting/multicast/enabled", False, ""
    yield "transport/shared_memory/enabled", False, ""
    yield "transport/link/tx/queue/size/real_time", _URGENT_BATCHES, ""
    for knob, key in _TLS.items():
        if getattr(config, knob):
            yield f"transport/link/tls/{key}", getattr(config, knob), knob
    if config.tls_mutual or config.tls_connect_certificate:  # zenoh shows no certificate unless it asks for one as well
        yield "transport/link/tls/enable_mtls", True, "tls_mutual"
    yield from _users(config)
    if guarded:
        yield "access_control", access_control(config), "command_names" if config.command_names else "command_users"


def _users(config: BusConfig) -> Iterator[tuple[str, Any, str]]:
    if config.users_file:
        yield "transport/auth/usrpwd/dictionary_file", config.users_file, "users_file"
    if config.user:
        yield "transport/auth/usrpwd/user", config.user, "user"
        yield "transport/auth/usrpwd/password", text_of(config, "password_file").strip(), "password_file"


def reason(error: zenoh.ZError) -> str:
    """zenoh's own words in one line, without the places in its source."""
    return " ".join(_SOURCE_LINE.sub("", str(error)).split())
