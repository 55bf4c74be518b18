"""Settings of the bus: errors are reported before a session is opened, in one line that names the knob."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from omnid.errors import OmnidError
from omnid.transport.access import access_control
from omnid.transport.bus_config import BusConfig, checked
from omnid.transport.session import open_session, zenoh_config


def refused(**knobs: Any) -> str:
    with pytest.raises(OmnidError) as caught:
        checked(BusConfig(**knobs))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "knob", ["config", "tls_ca", "tls_listen_key", "tls_connect_certificate", "users_file", "password_file"]
)
def test_a_missing_file_is_named(knob: str, tmp_path: Path) -> None:
    error = refused(**{knob: str(tmp_path / "nowhere")})
    assert f"bus.{knob}" in error and "nowhere" in error and "No such file" in error


@pytest.mark.parametrize("knob", ["config", "tls_ca", "users_file"])
def test_a_binary_file_is_refused(knob: str, tmp_path: Path) -> None:
    path = tmp_path / "binary"
    path.write_bytes(bytes(range(256)))
    assert f"bus.{knob}" in refused(**{knob: str(path)})


def test_a_key_must_be_pem_and_users_have_passwords(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("hello\n")
    assert "PEM" in refused(tls_ca=str(path))
    assert "user:password" in refused(users_file=str(path))


@pytest.mark.parametrize(
    ("knobs", "other"),
    [
        ({"mode": "client"}, "bus.connect"),
        ({"user": "ada"}, "bus.password_file"),
        ({"listen": ("tls/127.0.0.1:1",)}, "bus.tls_listen_key"),
        ({"tls_mutual": True}, "bus.tls_ca"),
        ({"command_names": ("driver",)}, "bus.tls_mutual"),
        ({"command_users": ("ada",)}, "bus.users_file"),
    ],
)
def test_a_missing_knob_is_named(knobs: dict[str, Any], other: str) -> None:
    assert other in refused(**knobs)


PROTOCOLS, LARGEST = "transport/link/protocols", "transport/link/rx/max_message_size"


def setting(config: BusConfig, key: str) -> Any:
    return json.loads(zenoh_config(config).get_json(key))


def test_default_is_local_without_multicast_and_denies_writing() -> None:
    assert setting(BusConfig(), "listen/endpoints") == ["tcp/127.0.0.1:7447"]
    assert setting(BusConfig(), "scouting/multicast/enabled") is False
    assert setting(BusConfig(), "access_control")["default_permission"] == "deny"


@pytest.mark.parametrize(
    ("ros2", "stops", "commands"),
    [
        ("off", ["robot7/cmd/stop"], ["robot7/cmd/**"]),
        ("rmw_zenoh", ["robot7/cmd/stop", "5/robot7/cmd/stop/**"], ["robot7/cmd/**", "5/robot7/cmd/**"]),
    ],
)
@pytest.mark.parametrize("names", [(), ("boss",)])
def test_everybody_may_stop_and_only_named_programs_command(
    ros2: str, stops: list[str], commands: list[str], names: tuple[str, ...]
) -> None:
    """The rules as they stand, for each way to ROS 2; another key cannot be written."""
    rules = access_control(BusConfig(robot="robot7", ros2=ros2, ros2_domain=5, command_names=names))
    written = {
        rule["id"]: rule["key_exprs"]
        for rule in rules["rules"]
        if rule["permission"] == "allow" and "ingress" in rule["flows"] and "put" in rule["messages"]
    }
    assert written == {"stop": stops, "command": commands} and rules["default_permission"] == "deny"
    subjects = {policy["id"]: (policy["rules"], policy["subjects"]) for policy in rules["policies"]}
    assert "stop" in subjects["all"][0] and subjects["all"][1] == ["everybody"]
    asked = [
        (rule["id"], rule["key_exprs"])
        for rule in rules["rules"]
        if rule["flows"] == ["ingress"]
        and "query" in rule["messages"]
        and any("@request" in key for key in rule["key_exprs"])
    ]
    assert asked == [("request", ["robot7/@request/*"])], "a star does not match what begins with @"
    assert subjects["some"] == (["command", "request"], ["name-0"] if names else ["everybody"])


def test_introduces_no_peers_and_uses_the_configured_protocols_only(tmp_path: Path) -> None:
    assert setting(BusConfig(), "scouting/gossip/enabled") is False
    assert setting(BusConfig(), PROTOCOLS) == ["tcp"]
    assert setting(BusConfig(listen=("tls/[::]:7447",)), PROTOCOLS) == ["tls"]
    both = BusConfig(listen=("tls/[::]:7447",), connect=("quic/site:1", "tls/site:1"))
    assert setting(both, PROTOCOLS) == ["quic", "tls"]
    path = tmp_path / "zenoh.json5"
    path.write_text("{ listen: {endpoints: {peer: ['ws/127.0.0.1:1']}} }")
    assert setting(BusConfig(config=str(path)), PROTOCOLS) == ["ws"]
    path.write_text("{ transport: {link: {protocols: ['udp', 'tcp']}} }")
    assert setting(BusConfig(config=str(path)), PROTOCOLS) == ["udp", "tcp"]


def test_limits_what_others_may_send_to_the_daemon_but_not_to_its_clients() -> None:
    assert setting(BusConfig(), LARGEST) == 1 << 20
    client = zenoh_config(BusConfig(mode="client", connect=("tcp/127.0.0.1:1",)), guarded=False)
    assert json.loads(client.get_json(LARGEST)) > 1 << 28, "a cloud of ten million points is sent as one message"


def test_settings_override_zenohs_own_file(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text("""{ // as zenohd reads it
        listen: {endpoints: ["tcp/127.0.0.1:1"]}, connect: {endpoints: ["tcp/127.0.0.1:2"]},
        transport: {link: {tx: {lease: 1234}}} }""")
    config = BusConfig(config=str(path), connect=("tcp/127.0.0.1:3",))
    assert setting(config, "listen/endpoints") == ["tcp/127.0.0.1:1"]
    assert setting(config, "connect/endpoints") == ["tcp/127.0.0.1:3"]
    assert setting(config, "transport/link/tx/lease") == 1234
    assert setting(config, "scouting/multicast/enabled") is False


def test_an_invalid_zenoh_file_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text("{ mode: 'emperor' }")
    with pytest.raises(OmnidError, match=r"bus\.config") as caught:
        open_session(BusConfig(config=str(path)))
    assert "\n" not in str(caught.value) and ".rs:" not in str(caught.value)
