"""Intake of commands and requests: stops first, bounded floods, answers, keys that no star matches, stop datagrams."""

from __future__ import annotations

import contextlib
import socket
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import zenoh

from omnid.client import Answer, Robot
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import WARN
from omnid.transport.intake import UNKNOWN_HZ, burst_of
from omnid.transport.status_names import BUS, entry
from omnid.transport.stop_datagram import ASKED, STOPPED, StopListener, StopSender, addresses
from omnid.transport.topics import COMMANDS, Request, command_of, command_topics, request_key
from tests.omnid.transport.bus_fixtures import free_endpoint, robot, script
from tests.waiting import wait_until

REQUEST_TOPICS = {topic for topic, command in COMMANDS.items() if command.is_request}


@pytest.mark.parametrize("topic", sorted(REQUEST_TOPICS))
def test_no_star_matches_the_key_of_a_request(topic: str) -> None:
    key = zenoh.KeyExpr(f"omnid/{request_key(topic)}")
    assert not any(zenoh.KeyExpr(pattern).intersects(key) for pattern in ("**", "omnid/**", "omnid/*/*"))
    assert str(key).endswith(topic.removeprefix("cmd"))


@pytest.mark.hazard("H49")
def test_a_query_for_several_keys_is_no_request() -> None:
    """Else one query would arm the robots of a whole site, and give each topic a payload of another."""
    with robot() as (_, program, received):
        for key in ("**", "omnid/**", "*/@request/arm", "omnid/@request/*", "**/@request/**", "omnid/*/arm"):
            assert list(program._session.get(key, payload=codec.header_cdr(time.time_ns()), timeout=1.0)) == [], key
        assert received == []


def test_of_a_stop_and_a_request_to_arm_in_one_pass_the_stop_wins() -> None:
    with robot() as (bus, program, received):
        driver = program.driver()
        wait_until(lambda: driver.connected)
        assert bus._commands is not None
        bus._pollers[-2].close()  # the passes are made here
        stop, ask = program._session.put, program._session.get
        stop("omnid/cmd/stop", b"")
        reply = ask("omnid/@request/arm", payload=codec.header_cdr(time.time_ns()), timeout=5.0)
        time.sleep(0.5)
        bus._commands.process()
        assert [request.topic for request in received] == ["cmd/stop", "cmd/arm", "cmd/stop"]
        del reply


def test_large_requests_are_dropped_before_they_wait() -> None:
    with robot() as (_, program, received):
        for topic in sorted(REQUEST_TOPICS - {"cmd/path"}):
            with pytest.raises(OmnidError, match="has not answered"):
                program.driver().ask(topic, lambda _: bytes(20_000), timeout_s=0.2)
        assert received == []
        with pytest.raises(OmnidError, match="has not answered"):
            program.driver().ask("cmd/path", lambda _: bytes(20_000), timeout_s=0.2)
        assert [request.topic for request in received] == ["cmd/path"]


FLOOD = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    key, block = sys.argv[2], zenoh.CongestionControl.BLOCK
    publisher = session.declare_publisher(key, congestion_control=block)
    print("ready", flush=True)
    while "@" not in key:
        publisher.put(b"")
    while True:
        session.get(key, lambda reply: None, payload=b"", congestion_control=block, timeout=1.0)
"""


@pytest.mark.hazard("H52")
@pytest.mark.parametrize("key", ["cmd/imu", "cmd/route", "cmd/arm", "cmd/nothing", "@request/arm", "@request/path"])
def test_a_flood_on_one_key_is_bounded_and_keeps_no_other_key_out(key: str) -> None:
    """Of the flood no more than the budget is passed on; a stop and a command on another key get through."""
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        commands: Counter[str] = Counter()

        def count(request: Request) -> None:
            commands[request.topic] += 1

        bus.subscribe_commands(count, command_topics(("operator",)))
        with script(FLOOD, endpoint, f"omnid/{key}"), Robot(connect=(endpoint,)) as operator:
            driver = operator.driver()
            wait_until(lambda: entry(BUS, bus.stats()).level == WARN)
            assert any(name.startswith("flooded, ") for name in entry(BUS, bus.stats()).values)
            topic = key.replace("@request", "cmd")
            begin_s, before = time.monotonic(), commands[topic]
            wait_until(lambda: driver.stop() is None and commands["cmd/stop"] > 0)
            wait_until(lambda: driver.twist(0.1, 0.0) is None and commands["cmd/twist"] > 0)
            time.sleep(1.0)
            rate_hz = UNKNOWN_HZ if key == "cmd/nothing" else command_of(topic).rate_hz
            most = 2 * burst_of(rate_hz) + rate_hz * (time.monotonic() - begin_s)
            assert commands[topic] - before <= most


@pytest.mark.parametrize("answer", [Answer(True, "driving"), Answer(False, "not armed: d\u00e9sarm\u00e9\n" * 50)])
def test_a_request_gets_the_answer_that_is_given_later(answer: Answer) -> None:
    with robot() as (bus, program, received), ThreadPoolExecutor(1) as thread:
        asked = thread.submit(program.driver().route, "repeat hall")
        wait_until(lambda: bool(received))
        assert received[0].topic == "cmd/route" and received[0].sender and received[0].id > 0
        assert abs(received[0].sent_ns - time.time_ns()) < 60 * 10**9 and not asked.done()
        bus.answer(received[0].id, answer)
        bus.answer(received[0].id, Answer(False, "a second one"))
        assert asked.result() == answer


def test_a_stop_is_confirmed_only_where_the_robot_says_so() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(robot="rover", listen=(endpoint,)))) as bus:
        commands: list[str] = []
        bus.subscribe_commands(lambda request: commands.append(request.topic), {})
        with contextlib.closing(StopSender("rover", (endpoint,))) as sender:
            wait_until(lambda: sender.ask(0.1) == ASKED)
        assert commands
        commands.clear()
        with contextlib.closing(StopSender("other", (endpoint,))) as sender:
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
    [("", False), ("auth: {usrpwd: {dictionary_file: 'users'}}", True), ("link: {tls: {enable_mtls: true}}", True)],
)
def test_beyond_this_machine_only_without_users_and_certificates(tmp_path: Path, asked: str, proof: bool) -> None:
    port = int(free_endpoint().rpartition(":")[2])
    (tmp_path / "zenoh.json5").write_text(f"{{transport: {{{asked}}}}}")
    config = BusConfig(listen=(f"tcp/0.0.0.0:{port}",), config=str(tmp_path / "zenoh.json5"))
    listener = StopListener(config, lambda: None, lambda: False)
    with contextlib.closing(listener):
        assert [found.getsockname()[0] for found in listener._sockets] == ["127.0.0.1" if proof else "0.0.0.0"]
