"""Checks of the connections."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path

import pytest

from calib.rig_file import read_rig, write_rig
from omnid.doctor.finding import Finding
from omnid.doctor.wiring import bus, motor, rig
from omnid.transport.bus_config import BusConfig


@pytest.mark.parametrize(
    ("name", "level", "words"),
    [
        ("", "ok", "motor.port is empty"),
        ("simulated", "ok", "simulated"),
        ("/dev/ttyNONE", "error", "does not exist"),
        ("/etc/passwd", "error", "is no serial port"),
    ],
)
def test_checks_other_motor_settings(name: str, level: str, words: str) -> None:
    (found,) = motor(name)
    assert found.level == level and words in found.found


def test_checks_the_image_size_of_the_rig(scene: Path) -> None:
    file = scene / "rig.toml"
    size = read_rig(file).lower.camera.size
    assert all(finding.level != "error" for finding in rig(file, size))
    wrong = [finding for finding in rig(file, (1280, 960)) if finding.level == "error"]
    assert len(wrong) == 2 and "256x256" in wrong[0].found and "asks for 1280x960" in wrong[0].found


def test_warns_of_a_rig_without_masks(scene: Path, tmp_path: Path) -> None:
    bare, masked = tmp_path / "bare.toml", tmp_path / "masked.toml"
    whole = read_rig(scene / "rig.toml").at_height(1.2)
    write_rig(masked, whole)
    write_rig(bare, replace(whole, lower=replace(whole.lower, mask=None), upper=replace(whole.upper, mask=None)))
    (found,) = rig(bare, (256, 256))
    assert found.level == "warning" and "no mask for lower and upper" in found.found
    (found,) = rig(masked, (256, 256))
    assert found.level == "ok" and "between the viewpoints, 1.200 m above the floor" in found.found


def test_warns_of_a_rig_that_does_not_state_its_height(scene: Path) -> None:
    found = list(rig(scene / "rig.toml", (256, 256)))
    assert any(one.level == "warning" and "does not state the height" in one.found for one in found)
    assert not any("does not state" in one.found for one in rig(scene / "rig.toml", (256, 256), -1.2))


@pytest.mark.parametrize("text", [None, "", "nonsense = [", "schema = 99"])
def test_finds_a_rig_that_cannot_be_read(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "rig.toml").write_text(text)
    (found,) = rig(tmp_path / "rig.toml", (1280, 960))
    assert found.level == "error" and ("omnid calibrate" in found.found) != ("omnid calibrate" in found.advice)


def router(endpoint: str) -> list[Finding]:
    return [finding for finding in bus(BusConfig(connect=(endpoint,))) if finding.subject == "router"]


def test_checks_that_a_router_answers() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        here = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        assert [finding.level for finding in router(here)] == ["ok"]
    (found,) = router(here)
    assert found.level == "warning" and f"{here} does not answer: Connection refused" in found.found
    assert "lan.conf" in found.advice


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:7447", "unixsock-stream//tmp/x", "nonsense", ""])
def test_does_not_check_other_protocols(endpoint: str) -> None:
    (found,) = router(endpoint)
    assert found.level == "ok" and "is not checked" in found.found


@pytest.mark.parametrize("endpoint", ["tcp/no such host:1", "tcp/127.0.0.1:99999", "tcp/" + "x" * 300 + ":1"])
def test_warns_of_an_impossible_router(endpoint: str) -> None:
    assert [finding.level for finding in router(endpoint)] == ["warning"]


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/[::1]:7447", True),
        ("tcp/localhost:7447", True),
        ("unixsock-stream//run/x", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.168.1.2:7447", False),
        ("udp/robot.local:7447", False),
    ],
)
def test_warns_of_open_endpoints_without_command_users(endpoint: str, local: bool) -> None:
    for config in (BusConfig(listen=(endpoint,)), BusConfig(connect=(endpoint,))):
        found = [finding for finding in bus(config) if finding.subject == "bus"]
        assert (found == []) == local
        assert all(finding.level == "warning" and "bus.command_users" in finding.advice for finding in found)


def test_names_the_users_that_may_command(tmp_path: Path) -> None:
    users = tmp_path / "users"
    users.write_text("anna:secret")
    config = BusConfig(listen=("tcp/0.0.0.0:7447",), users_file=str(users), command_users=("anna",))
    (found,) = (finding for finding in bus(config) if finding.subject == "bus")
    assert found.level == "ok" and "from anna only" in found.found


def test_finds_wrong_bus_settings() -> None:
    (found,) = (finding for finding in bus(BusConfig(command_users=("anna",))) if finding.level == "error")
    assert "bus.users_file" in found.found
