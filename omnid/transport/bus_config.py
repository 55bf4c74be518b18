"""The knobs of the bus, and what is wrong with them before anything is opened."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Final

from omnid.errors import OmnidError
from omnid.settings import knob

KEY: Final = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")
_ENDPOINT: Final = re.compile(r"(tcp|udp|tls|quic|ws)/[^/\s]+:\d{1,5}([?#].*)?|unixsock-stream/\S+")
_ROS_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_FILES: Final = ("config", "tls_ca", "tls_listen_key", "tls_listen_certificate", "tls_connect_key",
                 "tls_connect_certificate", "password_file", "users_file")
_PAIRS: Final = (("tls_listen_key", "tls_listen_certificate"), ("tls_connect_key", "tls_connect_certificate"),
                 ("user", "password_file"))
_ENCRYPTED: Final = ("tls/", "quic/")
_LONGEST_FILE: Final = 1 << 20  # bytes


@dataclass(frozen=True, slots=True)
class BusConfig:
    """Where the bus is and who may do what on it: keys are `<robot>/...`; this machine only, unless told otherwise."""

    robot: str = knob("omnid", "first part of every key, and of the topics of --record")
    mode: str = knob("peer", "peer: others come here as well; client: everything goes through a router, which may come "
                     "later", choices=("peer", "client"))
    listen: tuple[str, ...] = knob(("tcp/127.0.0.1:7447",), "zenoh endpoints to listen on")
    connect: tuple[str, ...] = knob((), "zenoh endpoints to connect to")
    retry_s: float = knob(2.0, "longest wait between two tries to reach an endpoint of connect, s", low=0.1, high=60)
    config: str = knob("", "a zenoh file (JSON5) that is read first: what is set here goes over it")
    tls_ca: str = knob("", "certificate of who signs those of the others, PEM; for endpoints tls/...")
    tls_listen_key: str = knob("", "private key for those who connect to us, PEM")
    tls_listen_certificate: str = knob("", "certificate for those who connect to us, PEM")
    tls_connect_key: str = knob("", "private key for those we connect to, PEM")
    tls_connect_certificate: str = knob("", "certificate for those we connect to, PEM; with one, tls_mutual is on")
    tls_mutual: bool = knob(False, "whoever connects must show a certificate that tls_ca has signed")
    user: str = knob("", "our name for those who ask for one")
    password_file: str = knob("", "file with our password, one line")
    users_file: str = knob("", "who may connect: lines user:password")
    command_names: tuple[str, ...] = knob((), "who may send commands, by the common name of the certificate")
    command_users: tuple[str, ...] = knob((), "who may send commands, by user; neither: whoever can connect")
    ros2: str = knob("off", "how ROS 2 sees the topics: by rmw_zenoh or by zenoh-bridge-ros2dds",
                     choices=("off", "rmw_zenoh", "ros2dds"))
    ros2_domain: int = knob(0, "ROS_DOMAIN_ID, for rmw_zenoh", low=0, high=232)
    panorama_hz: float = knob(0.0, "panoramas on the bus per second, as JPEG; 0: none", low=0, high=60)


def checked(config: BusConfig) -> BusConfig:
    """The same; OmnidError where a name, an endpoint or a file cannot be used, or one knob asks for another."""
    for problem in _problems(config):
        raise OmnidError(problem)
    return config


def text_of(config: BusConfig, name: str) -> str:
    """The text of the file that a knob names; OmnidError where there is none."""
    path = getattr(config, name)
    try:
        with open(path, encoding="utf-8") as file:
            return file.read(_LONGEST_FILE)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise OmnidError(f"bus.{name}: cannot read {path!r}: {reason}; name a file that omnid may read") from None


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
    """Each file is read once, so that a wrong name is told now and not by whoever fails later because of it."""
    for name in _FILES:
        text = text_of(config, name) if getattr(config, name) else None
        if text is not None and name.startswith("tls_") and "-----BEGIN " not in text:
            yield f"bus.{name}: {getattr(config, name)!r} has no PEM block; give a file with -----BEGIN ...-----"
        if text is not None and name == "users_file" and not all(map(_is_user, filter(None, text.splitlines()))):
            yield f"bus.users_file: {config.users_file!r} has a line that is not user:password"


def _is_user(line: str) -> bool:
    user, colon, password = line.partition(":")
    return bool(user and colon and password)


def _missing(config: BusConfig) -> Iterator[str]:
    """What one knob needs of another."""
    for a, b in _PAIRS:
        for given, other in ((a, b), (b, a)):
            if getattr(config, given) and not getattr(config, other):
                yield f"bus.{given} is set and bus.{other} is not; they belong together"
    if any(endpoint.startswith(_ENCRYPTED) for endpoint in config.listen) and not config.tls_listen_key:
        yield "bus.listen has a tls or quic endpoint; set bus.tls_listen_key and bus.tls_listen_certificate for it"
    if config.tls_mutual and not config.tls_ca:
        yield "bus.tls_mutual is set; name in bus.tls_ca who signs the others' certificates"
    if config.command_names and not config.tls_mutual:
        yield "bus.command_names are names of certificates; set bus.tls_mutual so that they are asked for"
    if config.command_users and not config.users_file:
        yield "bus.command_users are set; give their passwords in bus.users_file"


def set_knobs(config: BusConfig) -> frozenset[str]:
    """The names of the knobs that are not at their default."""
    usual = BusConfig()
    names = (entry.name for entry in fields(config))
    return frozenset(name for name in names if getattr(config, name) != getattr(usual, name))
