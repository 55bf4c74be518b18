"""zenoh sessions with the settings of the configuration.

Rules, limits and timing are those of zenoh's own file `bus.config`, of which `site.json5` is an example, and where that
says nothing those of `default.json5`. zenoh applies the rules where a link enters the session, so that refused messages
never reach the daemon.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from importlib.resources import files
from typing import Annotated, Any, Final, Literal

import zenoh
from msgspec import Meta

from omnid.errors import OmnidError

HERE: Final = "tcp/127.0.0.1:7447"
_NAME: Final = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*")
ALIVE: Final = "alive"  # key of the liveliness token below the robot's name
_ROS_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_SOURCE_LINE: Final = re.compile(r"\s+at /\S+\.rs:\d+\.?")
_PROTOCOLS: Final = "transport/link/protocols"
PERIOD_S: Final = 0.004  # time between two looks at what has no wait with a timeout
CONNECT_S: Final = 2.0  # A connection is complete, and a query is answered, within this time.
# zenoh's threads (zenoh-runtime): what one robot receives needs one, and accepting links none of its own.
_THREADS: Final = "(rx: (worker_threads: 1), acc: (handover: app))"
_DEFAULTS: Final = (  # what zenoh's own file may leave to default.json5
    "connect/retry",
    "scouting/multicast/enabled",
    "scouting/gossip/enabled",
    "transport/shared_memory/enabled",
    "transport/link/tx/queue/size/real_time",
)
_GUARDS: Final = ("transport/link/rx/max_message_size", "low_pass_filter", "access_control")


@dataclass(frozen=True, slots=True)
class BusConfig:
    """Endpoints of the bus; keys are `<robot>/...`. The default is this machine only."""

    robot: Annotated[str, "first part of every key, and of the topics of --record"] = "omnid"
    listen: Annotated[
        tuple[str, ...],
        "zenoh endpoints to listen on; [] with an endpoint in connect: a client, all of whose traffic goes through "
        "that router, which is there when the robot starts",
    ] = (HERE,)
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


class Unreachable(OmnidError):  # noqa: N818 - a state that may pass, as the errors of sockets
    """No endpoint answers a client, or the answer refuses it."""


def open_session(config: BusConfig, *, guarded: bool = True) -> zenoh.Session:
    """Open a session. Raise OmnidError where an endpoint cannot be listened on, Unreachable for a client.

    guarded: other programs may write commands only, and cannot send messages above 1 MiB. Clients are not guarded: the
    messages of a robot may be larger.
    """
    prepared = zenoh_config(config, guarded=guarded)
    os.environ.setdefault("ZENOH_RUNTIME", _THREADS)
    try:
        return zenoh.open(prepared)
    except zenoh.ZError as error:
        if config.is_client:
            raise Unreachable(
                f"cannot reach a robot at {', '.join(config.connect)}: start it, or a router, there, or name another "
                f"endpoint by --connect or bus.connect ({reason(error)})"
            ) from error
        raise OmnidError(
            f"bus cannot listen on {', '.join(config.listen)}: stop the other program there or change bus.listen; of a "
            f"router such as rmw_zenohd be a client: bus.listen = [], bus.connect = its endpoint ({reason(error)})"
        ) from error


def open_client(given: BusConfig) -> zenoh.Session:
    """Open the session of a program that listens to robots and commands them; bus.listen does not count.

    Raise Unreachable where no endpoint answers within CONNECT_S, OmnidError for wrong settings.
    """
    # Peers that only share a router exchange no messages, clients do.
    config = BusConfig(robot=given.robot, listen=(), connect=given.connect or (HERE,), config=given.config)
    return open_session(config, guarded=False)


def has_receiver(declared: zenoh.Publisher | zenoh.Querier) -> bool:
    """Return whether a program takes what a publisher sends, or what a querier asks."""
    status: Any = declared.matching_status  # zenoh's stub takes it for a bool
    return bool(status.matching)


def zenoh_config(config: BusConfig, *, guarded: bool = True) -> zenoh.Config:
    """Return zenoh's configuration: the endpoints of [bus], all else by its own file, else by omnid's defaults.

    zenoh's defaults are replaced because they listen on all interfaces and use multicast. Raise OmnidError for an
    invalid name or endpoint, or a file that cannot be used.
    """
    if not (_NAME if config.ros2 == "off" else _ROS_NAME).fullmatch(config.robot):
        raise OmnidError(
            f"bus.robot is {config.robot!r}; use letters, digits, '_', '.', '-' and inner '/'; with ROS 2 neither '.' "
            "nor '-', and a letter first"
        )
    result, untouched = _of_file(config), zenoh.Config()
    # 1. Who connects where is set by [bus].
    endpoints: dict[str, Any] = {
        "mode": "client" if config.is_client else "peer",
        "listen/endpoints": list(config.listen),
        "connect/endpoints": list(config.connect),
        "connect/exit_on_failure": config.is_client,
    }
    if config.is_client:
        # A client that cannot reach its router opens no session.
        endpoints["connect/timeout_ms"] = round(1000 * CONNECT_S)
    try:
        for key, value in endpoints.items():
            result.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise OmnidError(f"bus.listen, bus.connect: {reason(error)}; an example is {HERE}") from error
    # 2. omnid's defaults, where the file says nothing.
    text = (files("omnid.transport") / "default.json5").read_text("utf-8")
    names = {"ROBOT": config.robot, "DOMAIN": str(config.ros2_domain)}
    defaults = zenoh.Config.from_json5(re.sub("ROBOT|DOMAIN", lambda found: names[found[0]], text))
    for key in (*_DEFAULTS, *(_GUARDS if guarded else ())):
        if result.get_json(key) == untouched.get_json(key):
            result.insert_json5(key, defaults.get_json(key))
    # 3. No links of other protocols than those of the endpoints.
    if json.loads(result.get_json(_PROTOCOLS)) is None:
        used = {endpoint.partition("/")[0] for endpoint in (*config.listen, *config.connect)}
        result.insert_json5(_PROTOCOLS, json.dumps(sorted(used)))
    return result


def needs_proof(config: BusConfig) -> bool:
    """True if who connects must show a password or a certificate, by zenoh's own file."""
    users, certificates = "transport/auth/usrpwd/dictionary_file", "transport/link/tls/enable_mtls"
    found = _of_file(config)
    return json.loads(found.get_json(users)) is not None or bool(json.loads(found.get_json(certificates)))


def reason(error: zenoh.ZError) -> str:
    """Return zenoh's message in one line, without references to its sources."""
    return " ".join(_SOURCE_LINE.sub("", str(error)).split())


def _of_file(config: BusConfig) -> zenoh.Config:
    try:
        return zenoh.Config.from_file(config.config) if config.config else zenoh.Config()
    except zenoh.ZError as error:
        raise OmnidError(f"bus.config: {config.config!r} cannot be used: {reason(error)}") from error
