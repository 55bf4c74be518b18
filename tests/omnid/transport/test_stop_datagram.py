"""Stops beside the sessions of the bus."""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path

import pytest

from omnid.errors import OmnidError
from omnid.monitor.stopping import stop
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.requests import Request
from omnid.transport.stop_datagram import ASKED, STOPPED, StopSender, addresses
from tests.omnid.transport.bus_fixtures import free_endpoint, script, wait_until

CROWD = """
import json, sys, time, zenoh
held = []
while True:
    config = zenoh.Config()
    for name, value in (("mode", "client"), ("connect/endpoints", [sys.argv[1]]), ("scouting/multicast/enabled", False),
                        ("connect/timeout_ms", 1000)):
        config.insert_json5(name, json.dumps(value))
    try:
        held.append(zenoh.open(config))
    except zenoh.ZError:
        break
print("ready", flush=True)
time.sleep(1000)
"""


def test_a_stop_gets_through_when_all_sessions_are_taken(tmp_path: Path) -> None:
    endpoint, stopped, few = free_endpoint(), [False], tmp_path / "few.json5"
    few.write_text("{transport: {unicast: {max_sessions: 4}}}")
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,), config=str(few)))) as bus:
        commands: list[str] = []

        def execute(request: Request) -> None:
            commands.append(request.topic)
            stopped[0] = request.topic == "cmd/stop"

        bus.subscribe_commands(execute, {}, lambda: stopped[0])
        with script(CROWD, endpoint):
            assert stop(BusConfig(connect=(endpoint,)))
    assert set(commands) == {"cmd/stop"}


def test_a_stop_is_confirmed_only_where_the_robot_says_so() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(robot="rover", listen=(endpoint,)))) as bus:
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), {})
        with StopSender("rover", (endpoint,)) as sender:
            wait_until(lambda: sender.ask(0.1) == ASKED)
        assert commands
        commands.clear()
        with StopSender("other", (endpoint,)) as sender:
            assert sender.ask(0.3) == "" and not commands, "it is for another robot"


def test_nothing_else_stops_and_no_answer_is_longer_than_its_request() -> None:
    endpoint = free_endpoint()
    host, port = next(iter(addresses((endpoint,))))
    with (
        contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), {}, lambda: True)
        good = b"omnid stop 1 0123456789abcdef omnid" + b" " * 8
        for data in (b"", b"\xff" * 2000, good[:-12], good.upper(), good + b"\n", good.replace(b"omnid ", b"omni ")):
            stranger.sendto(data, (host, port))
        stranger.sendto(good, (host, port))
        stranger.settimeout(30.0)
        answer = stranger.recv(4096)
        assert answer.endswith(STOPPED.encode()) and len(answer) <= len(good) and commands == ["cmd/stop"]


@pytest.mark.parametrize("proof", [False, True])
def test_beyond_this_machine_only_without_users_and_certificates(tmp_path: Path, proof: bool) -> None:
    port = int(free_endpoint().rpartition(":")[2])
    users = tmp_path / "users"
    users.write_text("ada:secret\n")
    config = BusConfig(listen=(f"tcp/0.0.0.0:{port}",), users_file=str(users) if proof else "")
    with contextlib.closing(Bus(config)) as bus:
        bus.subscribe_commands(lambda *_: None, {})
        assert bus._stop_listener is not None
        hosts = [found.getsockname()[0] for found in bus._stop_listener._sockets]
        assert hosts == ["127.0.0.1" if proof else "0.0.0.0"]


def test_without_a_robot_there_the_error_is_that_of_the_bus() -> None:
    with pytest.raises(OmnidError, match="cannot reach"):
        stop(BusConfig(connect=(free_endpoint(),)), answer_s=1.0)
