"""Stops beside the sessions of the bus."""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path

import pytest

from omnid.transport.bus import Bus, BusConfig
from omnid.transport.stop_datagram import ASKED, STOPPED, StopListener, StopSender, addresses
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.waiting import wait_until


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


@pytest.mark.parametrize(
    ("asked", "proof"),
    [
        ("", False),
        ("auth: {usrpwd: {dictionary_file: 'users'}}", True),
        ("link: {tls: {enable_mtls: true}}", True),
    ],
)
def test_beyond_this_machine_only_without_users_and_certificates(tmp_path: Path, asked: str, proof: bool) -> None:
    port = int(free_endpoint().rpartition(":")[2])
    (tmp_path / "zenoh.json5").write_text(f"{{transport: {{{asked}}}}}")
    config = BusConfig(listen=(f"tcp/0.0.0.0:{port}",), config=str(tmp_path / "zenoh.json5"))
    listener = StopListener(config, lambda: None, lambda: False)
    with contextlib.closing(listener):
        assert [found.getsockname()[0] for found in listener._sockets] == ["127.0.0.1" if proof else "0.0.0.0"]
