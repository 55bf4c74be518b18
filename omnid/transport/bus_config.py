"""Settings of the bus, checked before a session is opened."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from msgspec import Meta

from omnid.errors import OmnidError

KEY: Final = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")
_ENDPOINT: Final = re.compile(r"(tcp|udp|tls|quic|ws)/[^/\s]+:\d{1,5}([?#].*)?|unixsock-stream/\S+")
_ROS_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


@dataclass(frozen=True, slots=True)
class BusConfig:
    """Endpoints of the bus; keys are `<robot>/...`. The default is this machine only."""

    robot: Annotated[str, "first part of every key, and of the topics of --record"] = "omnid"
    listen: Annotated[
        tuple[str, ...],
        "zenoh endpoints to listen on; [] with an endpoint in connect: a client, all of whose traffic goes through "
        "that router, which may be started later",
    ] = ("tcp/127.0.0.1:7447",)
    connect: Annotated[tuple[str, ...], "zenoh endpoints to connect to"] = ()
    config: Annotated[
        str, "a zenoh configuration file (JSON5): TLS, users, who may command; omnid/transport/site.json5 is an example"
    ] = ""
    ros2: Annotated[Literal["off", "rmw_zenoh"], "connection to ROS 2 by its middleware rmw_zenoh"] = "off"
    ros2_domain: Annotated[int, Meta(ge=0, le=232), "ROS_DOMAIN_ID, for rmw_zenoh"] = 0
    panorama_hz: Annotated[
        float, Meta(ge=0, le=60), "panoramas on the bus per second, as JPEG, made while somebody subscribes; 0: none"
    ] = 2.0

    @property
    def is_client(self) -> bool:
        """True where all traffic goes through a router."""
        return bool(self.connect) and not self.listen


def checked(config: BusConfig) -> BusConfig:
    """Return the settings unchanged. Raise OmnidError for an invalid name or endpoint, or a file that is unreadable."""
    if not KEY.fullmatch(config.robot):
        raise OmnidError(f"bus.robot is {config.robot!r}; use letters, digits, '_', '.', '-' and inner '/'")
    if config.ros2 != "off" and not _ROS_NAME.fullmatch(config.robot):
        raise OmnidError(
            f"bus.robot is {config.robot!r}; ROS 2 takes letters, digits, '_' and inner '/', a letter first"
        )
    for name, endpoints in (("listen", config.listen), ("connect", config.connect)):
        for endpoint in endpoints:
            if not _ENDPOINT.fullmatch(endpoint):
                raise OmnidError(
                    f"bus.{name} has {endpoint!r}; write protocol/host:port, for example tcp/127.0.0.1:7447"
                )
    if config.config:
        text_of_file(config.config)
    return config


def text_of_file(path: str) -> str:
    """Return the text of zenoh's own file. Raise OmnidError where it cannot be read."""
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except (OSError, ValueError) as error:
        cause = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise OmnidError(f"bus.config: cannot read {path!r}: {cause}; name a readable file") from None
