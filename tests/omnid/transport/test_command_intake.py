"""Intake of commands: stops come first, one request has one key, and no key keeps another one out."""

from __future__ import annotations

import contextlib
import time
from collections import Counter

import pytest

from omnid.client import Robot
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import WARN
from omnid.transport.intake import UNKNOWN, budget_of
from omnid.transport.requests import Request
from omnid.transport.topics import REQUEST_TOPICS, command_topics
from tests.omnid.transport.bus_fixtures import free_endpoint, robot, script
from tests.waiting import wait_until


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
            wait_until(lambda: bus.status().level == WARN)
            assert any(name.startswith("flooded, ") for name in bus.status().values)
            topic = key.replace("@request", "cmd")
            begin_s, before = time.monotonic(), commands[topic]
            wait_until(lambda: driver.stop() is None and commands["cmd/stop"] > 0)
            wait_until(lambda: driver.twist(0.1, 0.0) is None and commands["cmd/twist"] > 0)
            time.sleep(1.0)
            budget = UNKNOWN if key == "cmd/nothing" else budget_of(topic)
            most = 2 * budget.burst + budget.rate_hz * (time.monotonic() - begin_s)
            assert commands[topic] - before <= most
