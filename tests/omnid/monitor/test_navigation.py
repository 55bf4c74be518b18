"""Requests of commands: stops until they are confirmed, drives until their end."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from omnid.client import NavigationReport, Robot
from omnid.errors import OmnidError
from omnid.monitor import navigation
from omnid.monitor.navigation import stop
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus, string_from_cdr
from omnid.transport.status_names import DISARMED_BY_STOP, NAVIGATION, WHEELS, Key
from omnid.transport.topics import NAVIGATION as NAVIGATION_TOPIC
from omnid.transport.topics import Answer, Request, command_topics
from tests.omnid.transport.bus_fixtures import free_endpoint, script
from tests.waiting import wait_until

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


COMMAND_NS = 7
GOTO = ("goto", "1", "0")
REPEAT = ("route", "repeat", "hall")
# The command omnid. Below nohup commands ignore a terminal that closes, those of tests that are run that way, too.
HEARS_ALL = """import runpy, signal
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module("omnid", run_name="__main__")
"""


@pytest.mark.hazard("H25")
def test_a_silent_robot_is_not_reported_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing on a robot watches the program that has asked for a drive: it goes on without the network."""
    monkeypatch.setattr(navigation, "SILENCE_S", 0.5)
    endpoint = free_endpoint()
    shown: list[NavigationReport] = []
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        publish_driving(bus, COMMAND_NS)
        with Robot("omnid", endpoint, timeout_s=30.0) as robot, pytest.raises(OmnidError, match="silent") as caught:
            shown.extend(navigation.reports_of(robot, COMMAND_NS))
    assert [report.state for report in shown] == ["driving"]
    assert "it drives on (`omnid stop`" in str(caught.value)


def publish_driving(bus: Bus, command_ns: int) -> None:
    """Publish a report of a drive that a request with this stamp began."""
    values = {str(Key.STATE): "driving", str(Key.COMMAND_NS): str(command_ns)}
    entry = DiagnosticStatus(NAVIGATION, 0, "", values)
    bus.publish("navigation", codec.diagnostics_cdr(time.time_ns(), [entry]))


def test_a_drive_that_another_request_replaces_has_ended() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        publish_driving(bus, COMMAND_NS)
        with Robot("omnid", endpoint, timeout_s=30.0) as robot:
            stamps_ns = []
            for report in navigation.reports_of(robot, COMMAND_NS):
                stamps_ns.append(report.command_ns)
                publish_driving(bus, COMMAND_NS + 1)
    assert (stamps_ns[0], stamps_ns[-1]) == (COMMAND_NS, COMMAND_NS + 1)


@pytest.mark.hazard("H25")
@pytest.mark.parametrize("is_answered", [True, False])
@pytest.mark.parametrize(
    ("words", "number"),
    [(GOTO, signal.SIGINT), (GOTO, signal.SIGTERM), (REPEAT, signal.SIGINT), (REPEAT, signal.SIGHUP)],
)
def test_a_drive_is_cancelled_when_its_command_is_ended(
    words: tuple[str, ...], number: signal.Signals, is_answered: bool
) -> None:
    """By Ctrl-C, by its terminal that closes, or by a script; also while the robot has not yet answered."""
    endpoint, asked, cancelled = free_endpoint(), list[str](), list[str]()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:

        def take(request: Request) -> None:
            if request.topic == NAVIGATION_TOPIC:
                cancelled.append(string_from_cdr(request.payload))
                bus.answer(request.id, Answer(True, "cancelled"))
                return
            if is_answered:
                bus.answer(request.id, Answer(True, "it drives"))
            asked.append(request.topic)

        bus.subscribe_commands(take, command_topics(("operator",)))
        command = [sys.executable, "-c", HEARS_ALL, *words, "--connect", endpoint]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            wait_until(lambda: len(asked) == 1)
            time.sleep(0.5)  # it waits for the answer, or for the end of the drive
            process.send_signal(number)
            try:
                process.communicate(timeout=30.0)
            finally:
                process.kill()
        assert cancelled == ["cancel"] and process.returncode == 1
