"""zenoh sessions with the settings of the configuration."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import zenoh

from omnid.errors import OmnidError
from omnid.transport.access import access_control
from omnid.transport.bus_config import BusConfig, set_knobs, text_of
from omnid.transport.topics import PATH, PUBLISHED, REQUEST_TOPICS, SERVED, command_topics, request_key

_OS_ERROR: Final = re.compile(r"\(os error (\d+)\)")
_NO_ANSWER: Final = re.compile(r"Unable to connect to any of \[.*\]\. Timeout!")
_SOURCE_LINE: Final = re.compile(r"\s+at /\S+\.rs:\d+\.?")
_PROTOCOLS: Final = "transport/link/protocols"
_PROTOCOL: Final = re.compile(r'"([a-z0-9_-]+)/')
_CONNECT_TIMEOUT_MS: Final = 1000  # a client that cannot reach its router opens no session
_REAL_TIME_BATCHES: Final = 16  # the default of 2 is soon full on a busy host, and poses are dropped
_MAX_RECEIVED_BYTES: Final = 1 << 20  # zenoh collects fragments up to its limit of 1 GiB before access rules apply
# Connections that send nothing hold one of the places for the time-out: 1000 of them lock others out for 1 s at most.
# zenoh's defaults are 100 places and 10 s.
_MAX_PENDING: Final = 1000
_ACCEPT_TIMEOUT_MS: Final = 1000
_MAX_COMMAND_BYTES: Final = 16_384  # Limit of all commands but paths.
_MAX_SESSIONS: Final = 128  # each holds received fragments in memory
# Limit for each link and key: zenoh ends each query that a ring drops by a message of its own, which takes time. A
# refused query has an empty answer at once. A program that asks for one key in a loop over loopback (0.1 ms an answer)
# is refused some, and must ask again, as `omnid.client` does.
_MAX_QUERIES_HZ: Final = 1000.0
_TLS: Final = {
    "tls_ca": "root_ca_certificate",
    "tls_listen_key": "listen_private_key",
    "tls_listen_certificate": "listen_certificate",
    "tls_connect_key": "connect_private_key",
    "tls_connect_certificate": "connect_certificate",
}


class EndpointTaken(OmnidError):  # noqa: N818 - a state that may pass, as the errors of sockets
    """An endpoint cannot be listened on."""


class Unreachable(OmnidError):  # noqa: N818 - a state that may pass, as the errors of sockets
    """No endpoint answers a client, or the answer refuses it."""


def open_session(config: BusConfig, *, guarded: bool = True) -> zenoh.Session:
    """Open a session. Raise EndpointTaken where an endpoint cannot be listened on, Unreachable for a client.

    guarded: other programs may write commands only, and cannot send messages above 1 MiB. Clients are not guarded: the
    messages of a robot may be larger.
    """
    prepared = zenoh_config(config, guarded=guarded)
    try:
        return zenoh.open(prepared)
    except zenoh.ZError as error:
        raise _failure(config, reason(error)) from error


def _failure(config: BusConfig, cause: str) -> OmnidError:
    if config.mode == "client":
        endpoints = ", ".join(config.connect)
        return Unreachable(
            f"bus cannot reach {endpoints}: start the robot or router there, or change bus.connect ({cause})"
        )
    endpoints = ", ".join(config.listen)
    return EndpointTaken(
        f"bus cannot listen on {endpoints}: stop the other program there or change bus.listen ({cause})"
    )


def router_in_place(config: BusConfig) -> BusConfig | None:
    """Return the configuration of a client of the router that holds the endpoints of a peer; None without a router."""
    client = replace(config, mode="client", listen=(), connect=config.listen)
    try:
        session = open_session(client, guarded=False)
    except OmnidError:
        return None
    try:
        return client if session.info.routers_zid() else None
    finally:
        session.close()  # type: ignore[no-untyped-call]  # the stub has no return type


def zenoh_config(config: BusConfig, *, guarded: bool = True) -> zenoh.Config:
    """Return zenoh's configuration: its own file first, omnid's defaults where that leaves zenoh's, then set knobs.

    zenoh's defaults are replaced because they listen on all interfaces and use multicast. Shared memory is off: it is
    faster above 100 kB only, and leaves files behind.
    """
    result, untouched, explicit = _of_file(config), zenoh.Config(), set_knobs(config)
    for key, value, knob in _settings(config, guarded):
        if knob == "mode" or knob in explicit or result.get_json(key) == untouched.get_json(key):
            result.insert_json5(key, json.dumps(value))
    _restrict_protocols(result)
    return result


def _restrict_protocols(result: zenoh.Config) -> None:
    """Allow no links of other protocols than those of the endpoints, unless zenoh's own file names protocols."""
    endpoints = result.get_json("listen/endpoints") + result.get_json("connect/endpoints")
    if json.loads(result.get_json(_PROTOCOLS)) is None:
        result.insert_json5(_PROTOCOLS, json.dumps(sorted(set(_PROTOCOL.findall(endpoints)))))


def _of_file(config: BusConfig) -> zenoh.Config:
    if not config.config:
        return zenoh.Config()
    try:
        return zenoh.Config.from_json5(text_of(config, "config"))
    except zenoh.ZError as error:
        message = f"bus.config: {config.config!r} is not a zenoh configuration: {reason(error)}; correct the file"
        raise OmnidError(message) from error


def _settings(config: BusConfig, guarded: bool) -> Iterator[tuple[str, Any, str]]:
    """Yield zenoh's key, its value, and the knob that sets it."""
    client = config.mode == "client"
    yield "mode", config.mode, "mode"
    yield "listen/endpoints", [] if client else list(config.listen), "listen"
    yield "connect/endpoints", list(config.connect), "connect"
    yield "connect/exit_on_failure", client, ""
    yield (
        "connect/retry",
        {
            "period_init_ms": min(500, round(1e3 * config.retry_s)),
            "period_max_ms": round(1e3 * config.retry_s),
            "period_increase_factor": 2,
        },
        "retry_s",
    )
    if client:
        yield "connect/timeout_ms", _CONNECT_TIMEOUT_MS, ""
    yield "scouting/multicast/enabled", False, ""
    yield "scouting/gossip/enabled", False, ""  # else a peer makes this one connect to endpoints of its choice
    yield "transport/shared_memory/enabled", False, ""
    yield "transport/link/tx/queue/size/real_time", _REAL_TIME_BATCHES, ""
    for knob, key in _TLS.items():
        if getattr(config, knob):
            yield f"transport/link/tls/{key}", getattr(config, knob), knob
    if config.tls_mutual or config.tls_connect_certificate:  # zenoh sends no certificate unless it requires one, too
        yield "transport/link/tls/enable_mtls", True, "tls_mutual"
    yield from _users(config)
    if guarded:
        yield "transport/link/rx/max_message_size", _MAX_RECEIVED_BYTES, ""
        yield "transport/unicast/accept_pending", _MAX_PENDING, ""
        yield "transport/unicast/accept_timeout", _ACCEPT_TIMEOUT_MS, ""
        yield "transport/unicast/max_sessions", _MAX_SESSIONS, ""
        yield "low_pass_filter", _size_limits(config), ""
        yield "downsampling", _query_rates(config), ""
        yield "access_control", access_control(config), "command_names" if config.command_names else "command_users"


def _size_limits(config: BusConfig) -> list[dict[str, Any]]:
    """Return the rule that bounds commands and requests in size: many of them wait at once."""
    short = [f"{config.robot}/{topic}" for topic in command_topics(()) if topic != PATH]
    plain = [*short, f"{config.robot}/cmd/*/*"]
    ros = [f"{config.ros2_domain}/{key}/*/*" for key in plain] if config.ros2 == "rmw_zenoh" else []
    requests = [f"{config.robot}/{request_key(topic)}" for topic in sorted(REQUEST_TOPICS - {PATH})]
    return [
        {
            "id": "commands",
            "flows": ["ingress"],
            "messages": ["put", "query"],
            "key_exprs": plain + ros + requests,
            "size_limit": _MAX_COMMAND_BYTES,
        }
    ]


def _query_rates(config: BusConfig) -> list[dict[str, Any]]:
    """Return the rules that bound how often a link may ask.

    Each key has one: a rule refuses what comes sooner than the time between two messages, of any of the keys it covers.
    """
    kept = [name.removeprefix("/") for name, topic in PUBLISHED.items() if topic.latched]
    asked = [*kept, *SERVED, *map(request_key, sorted(REQUEST_TOPICS))]
    keys = [f"{config.robot}/{name}" for name in asked]
    return [
        {
            "id": "queries",
            "flows": ["ingress"],
            "messages": ["query"],
            "rules": [{"key_expr": key, "freq": _MAX_QUERIES_HZ} for key in keys],
        }
    ]


def _users(config: BusConfig) -> Iterator[tuple[str, Any, str]]:
    if config.users_file:
        yield "transport/auth/usrpwd/dictionary_file", config.users_file, "users_file"
    if config.user:
        yield "transport/auth/usrpwd/user", config.user, "user"
        yield "transport/auth/usrpwd/password", text_of(config, "password_file").strip(), "password_file"


def reason(error: zenoh.ZError) -> str:
    """Return a common cause in a few words, else zenoh's message in one line without references to its sources."""
    text = " ".join(_SOURCE_LINE.sub("", str(error)).split())
    if by_system := _OS_ERROR.search(text):
        return os.strerror(int(by_system[1]))
    return "no answer" if _NO_ANSWER.fullmatch(text) else text
