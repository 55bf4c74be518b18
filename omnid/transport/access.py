"""Who may do what on the bus, as zenoh's access control puts it.

Everybody who can connect may listen and ask. Nobody may write but commands, and those only from whom the configuration
names; zenoh checks it where a link comes in, so what is refused never reaches the daemon.
"""

from __future__ import annotations

from typing import Any, Final

from omnid.transport.bus_config import BusConfig

_ALWAYS: Final = ("declare_subscriber", "declare_queryable", "query", "reply", "liveliness_token", "liveliness_query",
                  "declare_liveliness_subscriber")
_EVERYTHING: Final = ("**", "@/**", "@/*/@ros2_lv/**", "@ros2_lv/**")  # a star is not for a part that begins with @


def access_control(config: BusConfig) -> dict[str, Any]:
    """The rules as JSON, for zenoh's key access_control."""
    commanders = [_subject(f"name-{i}", cert_common_names=[name]) for i, name in enumerate(config.command_names)]
    commanders += [_subject(f"user-{i}", usernames=[user]) for i, user in enumerate(config.command_users)]
    everybody = _subject("everybody")
    obeyed = [subject["id"] for subject in commanders] or [everybody["id"]]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            _rule("hear", "egress", (*_ALWAYS, "put", "delete"), list(_EVERYTHING)),
            _rule("ask", "ingress", _ALWAYS, list(_EVERYTHING)),
            _rule("command", "ingress", ("put",), command_keys(config)),
        ],
        "subjects": [everybody, *commanders],
        "policies": [
            {"id": "all", "rules": ["hear", "ask"], "subjects": [everybody["id"]]},
            {"id": "some", "rules": ["command"], "subjects": obeyed},
        ],
    }


def command_keys(config: BusConfig) -> list[str]:
    """The keys that commands come by."""
    plain = f"{config.robot}/cmd/**"
    return [plain, f"{config.ros2_domain}/{plain}"] if config.ros2 == "rmw_zenoh" else [plain]


def _subject(name: str, **who: list[str]) -> dict[str, Any]:
    return {"id": name, **who}


def _rule(name: str, flow: str, messages: tuple[str, ...], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": keys}
