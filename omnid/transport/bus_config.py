"""Settings of the bus; `session.zenoh_config` checks them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from msgspec import Meta

KEY: Final = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")


@dataclass(frozen=True, slots=True)
class BusConfig:
    """Endpoints of the bus; keys are `<robot>/...`. The default is this machine only."""

    robot: Annotated[str, "first part of every key, and of the topics of --record"] = "omnid"
    listen: Annotated[
        tuple[str, ...],
        "zenoh endpoints to listen on; [] with an endpoint in connect: a client, all of whose traffic goes through "
        "that router, which is there when the robot starts",
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
