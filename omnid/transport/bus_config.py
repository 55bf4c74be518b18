"""Settings of the bus, checked before a session is opened."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Annotated, Final, Literal

from msgspec import Meta

from omnid.errors import OmnidError

KEY: Final = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")
_ENDPOINT: Final = re.compile(r"(tcp|udp|tls|quic|ws)/[^/\s]+:\d{1,5}([?#].*)?|unixsock-stream/\S+")
_ROS_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_FILES: Final = (
    "config",
    "tls_ca",
    "tls_listen_key",
    "tls_listen_certificate",
    "tls_connect_key",
    "tls_connect_certificate",
    "password_file",
    "users_file",
)
_PAIRS: Final = (
    ("tls_listen_key", "tls_listen_certificate"),
    ("tls_connect_key", "tls_connect_certificate"),
    ("user", "password_file"),
)
_ENCRYPTED: Final = ("tls/", "quic/")
_MAX_FILE_BYTES: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class BusConfig:
    """Endpoints of the bus and permissions on it; keys are `<robot>/...`. The default is this machine only."""

    robot: Annotated[str, "first part of every key, and of the topics of --record"] = "omnid"
    mode: Annotated[
        Literal["peer", "client"],
        "peer: other programs connect to this one; client: all traffic goes through a router, "
        "which may be started later",
    ] = "peer"
    listen: Annotated[tuple[str, ...], "zenoh endpoints to listen on"] = ("tcp/127.0.0.1:7447",)
    connect: Annotated[tuple[str, ...], "zenoh endpoints to connect to"] = ()
    retry_s: Annotated[
        float, Meta(ge=0.1, le=60), "longest wait between two attempts to reach an endpoint of connect, s"
    ] = 2.0
    config: Annotated[str, "a zenoh configuration file (JSON5) that is read first; settings here override it"] = ""
    tls_ca: Annotated[
        str, "certificate of the authority that signs the others' certificates, PEM; for tls/ endpoints"
    ] = ""
    tls_listen_key: Annotated[str, "private key for incoming connections, PEM"] = ""
    tls_listen_certificate: Annotated[str, "certificate for incoming connections, PEM"] = ""
    tls_connect_key: Annotated[str, "private key for outgoing connections, PEM"] = ""
    tls_connect_certificate: Annotated[str, "certificate for outgoing connections, PEM; with one, tls_mutual is on"] = (
        ""
    )
    tls_mutual: Annotated[bool, "clients must present a certificate that tls_ca has signed"] = False
    user: Annotated[str, "user name for outgoing connections"] = ""
    password_file: Annotated[str, "file with the password of user, one line"] = ""
    users_file: Annotated[str, "file with the users that may connect: lines user:password"] = ""
    command_names: Annotated[tuple[str, ...], "certificates (common names) that may send commands"] = ()
    command_users: Annotated[tuple[str, ...], "users that may send commands; with neither: all that can connect"] = ()
    command_clock: Annotated[
        Literal["synchronised", "arrival"],
        "synchronised: stamps of commands must be within controller.deadlines.command_s of this machine's clock; "
        "arrival: for senders with another clock, stamps must only rise",
    ] = "synchronised"
    ros2: Annotated[Literal["off", "rmw_zenoh"], "connection to ROS 2 by its middleware rmw_zenoh"] = "off"
    ros2_domain: Annotated[int, Meta(ge=0, le=232), "ROS_DOMAIN_ID, for rmw_zenoh"] = 0
    panorama_hz: Annotated[
        float, Meta(ge=0, le=60), "panoramas on the bus per second, as JPEG, made while somebody subscribes; 0: none"
    ] = 2.0


def checked(config: BusConfig) -> BusConfig:
    """Return the settings unchanged. Raise OmnidError for an invalid name, endpoint or file, or a missing knob."""
    for problem in _problems(config):
        raise OmnidError(problem)
    return config


def text_of(config: BusConfig, name: str) -> str:
    """Return the text of the file that a knob names. Raise OmnidError where it cannot be read."""
    path = getattr(config, name)
    try:
        with open(path, encoding="utf-8") as file:
            return file.read(_MAX_FILE_BYTES)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise OmnidError(f"bus.{name}: cannot read {path!r}: {reason}; name a readable file") from None


def _problems(config: BusConfig) -> Iterator[str]:
    if not KEY.fullmatch(config.robot):
        yield f"bus.robot is {config.robot!r}; use letters, digits, '_', '.', '-' and inner '/'"
    if config.ros2 != "off" and not _ROS_NAME.fullmatch(config.robot):
        yield f"bus.robot is {config.robot!r}; ROS 2 takes letters, digits, '_' and inner '/', a letter first"
    for name in ("listen", "connect"):
        for endpoint in getattr(config, name):
            if not _ENDPOINT.fullmatch(endpoint):
                yield f"bus.{name} has {endpoint!r}; write protocol/host:port, for example tcp/127.0.0.1:7447"
    if config.mode == "client" and not (config.connect or config.config):
        yield "bus.mode is 'client' and bus.connect is empty; name the router there"
    yield from _unfit_files(config)
    yield from _missing(config)


def _unfit_files(config: BusConfig) -> Iterator[str]:
    """Read each file once, so that a wrong name is reported here and not by a later failure of zenoh."""
    for name in _FILES:
        text = text_of(config, name) if getattr(config, name) else None
        if text is not None and name.startswith("tls_") and "-----BEGIN " not in text:
            yield f"bus.{name}: {getattr(config, name)!r} has no PEM block; name a file with -----BEGIN ...-----"
        if text is not None and name == "users_file" and not all(map(_is_user, filter(None, text.splitlines()))):
            yield f"bus.users_file: {config.users_file!r} has a line that is not user:password"


def _is_user(line: str) -> bool:
    user, colon, password = line.partition(":")
    return bool(user and colon and password)


def _missing(config: BusConfig) -> Iterator[str]:
    """Yield the knobs that are missing next to those that are set."""
    for a, b in _PAIRS:
        for given, other in ((a, b), (b, a)):
            if getattr(config, given) and not getattr(config, other):
                yield f"bus.{given} is set and bus.{other} is not; they belong together"
    if any(endpoint.startswith(_ENCRYPTED) for endpoint in config.listen) and not config.tls_listen_key:
        yield "bus.listen has a tls or quic endpoint; set bus.tls_listen_key and bus.tls_listen_certificate for it"
    if config.tls_mutual and not config.tls_ca:
        yield "bus.tls_mutual is set and bus.tls_ca is not; name the certificate of the authority there"
    if config.command_names and not config.tls_mutual:
        yield "bus.command_names are names of certificates; set bus.tls_mutual so that clients must present one"
    if config.command_users and not config.users_file:
        yield "bus.command_users are set; give their passwords in bus.users_file"


def set_knobs(config: BusConfig) -> frozenset[str]:
    """Return the names of the knobs that are not at their default."""
    default = BusConfig()
    names = (entry.name for entry in fields(config))
    return frozenset(name for name in names if getattr(config, name) != getattr(default, name))
