"""Permissions on the bus, as rules of zenoh's access control.

Every connected program may subscribe, query, and stop the wheels. Other commands, the release of a stop, and requests
are for those only that the configuration names; nothing else can be written, and only the robot answers requests. zenoh
applies the rules where a link enters the session, so that refused messages never reach the daemon. Where users or
certificates are configured, only the robot itself declares liveliness tokens below its name.
"""

from __future__ import annotations

from typing import Any, Final

from omnid.transport.bus_config import BusConfig
from omnid.transport.topics import STOP, request_key

_ALWAYS: Final = (
    "declare_subscriber",
    "declare_queryable",
    "query",
    "reply",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
# A star does not match parts that begin with @; @adv is the history that zenoh keeps for ROS 2's late subscribers.
_EVERYTHING: Final = ("**", "@/**", "@/*/@ros2_lv/**", "@ros2_lv/**", "**/@adv/**")


def access_control(config: BusConfig) -> dict[str, Any]:
    """Return the rules as JSON, for zenoh's key access_control."""
    commanders = [_subject(f"name-{i}", cert_common_names=[name]) for i, name in enumerate(config.command_names)]
    commanders += [_subject(f"user-{i}", usernames=[user]) for i, user in enumerate(config.command_users)]
    everybody = _subject("everybody")
    allowed = [subject["id"] for subject in commanders] or [everybody["id"]]
    names = ["own names"] if config.users_file or config.tls_mutual else []
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            _rule("subscribe", "egress", (*_ALWAYS, "put", "delete"), [*_EVERYTHING, request_keys(config)]),
            _rule("query", "ingress", _ALWAYS, list(_EVERYTHING)),
            _rule("stop", "ingress", ("put",), stop_keys(config)),
            _rule("command", "ingress", ("put",), command_keys(config)),
            _rule("request", "ingress", ("query",), [request_keys(config)]),
            _rule("own names", "ingress", ("liveliness_token",), [f"{config.robot}/**"], permission="deny"),
        ],
        "subjects": [everybody, *commanders],
        "policies": [
            {"id": "all", "rules": ["subscribe", "query", "stop", *names], "subjects": [everybody["id"]]},
            {"id": "some", "rules": ["command", "request"], "subjects": allowed},
        ],
    }


def command_keys(config: BusConfig) -> list[str]:
    """Return the key expressions of commands."""
    plain = f"{config.robot}/cmd/**"
    return [plain, f"{config.ros2_domain}/{plain}"] if config.ros2 == "rmw_zenoh" else [plain]


def request_keys(config: BusConfig) -> str:
    """Return the key expression of requests."""
    return f"{config.robot}/{request_key('*')}"


def stop_keys(config: BusConfig) -> list[str]:
    """Return the key expressions of the stop."""
    plain = f"{config.robot}/{STOP}"
    return [plain, f"{config.ros2_domain}/{plain}/**"] if config.ros2 == "rmw_zenoh" else [plain]


def _subject(name: str, **properties: list[str]) -> dict[str, Any]:
    return {"id": name, **properties}


def _rule(
    name: str, flow: str, messages: tuple[str, ...], keys: list[str], permission: str = "allow"
) -> dict[str, Any]:
    return {"id": name, "permission": permission, "flows": [flow], "messages": list(messages), "key_exprs": keys}
