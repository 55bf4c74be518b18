"""Stop a robot from another program, and wait until it confirms that."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

import pytest

from omnid.monitor.navigation import stop
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.requests import Request
from omnid.transport.status_names import DISARMED_BY_STOP, WHEELS, Key
from tests.omnid.transport.bus_fixtures import free_endpoint, script

STOPPED = DiagnosticStatus(WHEELS, 0, "", {Key.DISARMED_BY: DISARMED_BY_STOP})
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


@pytest.mark.hazard("H51")
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


def test_a_status_from_before_the_stop_does_not_confirm_it() -> None:
    """The robot has kept that of an earlier stop, and was armed since. As behind a router nothing answers datagrams."""
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        bus.publish("status", codec.diagnostics_cdr(time.time_ns(), [STOPPED]))
        stops: list[str] = []

        def execute(request: Request) -> None:
            stops.append(request.topic)
            if len(stops) == 3:
                bus.publish("status", codec.diagnostics_cdr(time.time_ns(), [STOPPED]))

        bus.subscribe_commands(execute, {})
        assert bus._stop_listener is not None
        bus._stop_listener.close()
        assert stop(BusConfig(connect=(endpoint,)))
    assert stops == ["cmd/stop"] * 3, "it is sent again until a new status confirms it"
