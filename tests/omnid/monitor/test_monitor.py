"""`omnid listen`, `drive`, `goto`, `route`, `stop`: what is shown, requests until their end, keys as a stick."""

from __future__ import annotations

import contextlib
import io
import math
import select
import signal
import subprocess
import sys
import time
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from omnid.client import NavigationReport, Robot
from omnid.core.control.heading_controller import VelocityLimits
from omnid.errors import OmnidError
from omnid.monitor import robot_state
from omnid.monitor.robot_state import ReceivedMessage, RobotState, pose_lines, print_state, status_table, stop
from omnid.monitor.teleop import HOLD_S, Stick
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus, PoseAttachment, string_from_cdr
from omnid.transport.status_names import BUS, DISARMED_BY_STOP, NAVIGATION, WHEELS, Key
from omnid.transport.topics import NAVIGATION as NAVIGATION_TOPIC
from omnid.transport.topics import Answer, Request
from tests.omnid.transport.bus_fixtures import DEADLINE_S, free_endpoint, script
from tests.waiting import OMNID, running, wait_until

pytestmark = pytest.mark.usefixtures("default_signals")


def odometry_at(number: int) -> bytes:
    T = se3.transform(se3.rotation_exp([0.0, 0.0, 0.1]), [0.5, 0.25, 0.0])
    return codec.odometry_cdr(10**18 + number, T, 1e-6 * np.eye(6), np.zeros(6), np.eye(6))


def publish(bus: Bus, number: int) -> None:
    bus.publish("odom", odometry_at(number), PoseAttachment(number, "tracking", 0, 50, 60, time.time_ns()).to_bytes())
    bus.publish("/tf", codec.transform_cdr(10**18, []))
    bus.publish("status", codec.diagnostics_cdr(10**18, [DiagnosticStatus(WHEELS, 1, "no command", {"sent": "4"})]))


def publish_until_it_ends(
    bus: Bus, process: subprocess.Popen[str], number_of_signal: signal.Signals
) -> tuple[str, str]:
    """Publish, and send the signal after the first line and 150 further messages."""
    deadline_s, further = time.monotonic() + DEADLINE_S, 0
    for number in count():
        publish(bus, number)
        time.sleep(0.01)
        further += bool(further or select.select([process.stdout], [], [], 0)[0])
        if further == 150:
            process.send_signal(number_of_signal)
        if process.poll() is not None:
            break
        assert time.monotonic() < deadline_s
    return process.communicate()


def test_listen_shows_the_robot_and_ends_with_a_signal() -> None:
    endpoint = free_endpoint()
    rover = contextlib.closing(Bus(BusConfig(robot="rover", listen=(endpoint,))))
    with rover as bus, running([*OMNID, "listen", "--robot", "rover", "--connect", endpoint]) as listening:
        out, err = publish_until_it_ends(bus, listening, signal.SIGTERM)
    assert listening.returncode == 0 and err == "" and "\x1b" not in out
    last = out.splitlines()[-1]
    assert last.startswith("rover: tracking  ") and "x +0.500 y +0.250" in last


def test_a_wrong_name_is_reported() -> None:
    endpoint = free_endpoint()
    idle = contextlib.closing(Bus(BusConfig(listen=(endpoint,), robot="hall/one")))
    with idle, running([*OMNID, "listen", "--connect", endpoint, "--seconds", 0.5]) as listening:
        out, _ = listening.communicate(timeout=DEADLINE_S)
    assert listening.returncode == 1 and out == "omnid: no pose yet: no robot of this name is there\n"


def received_message(number: int) -> ReceivedMessage:
    attachment = PoseAttachment(number, "tracking", 0, 50, 60, time.time_ns()).to_bytes()
    return ReceivedMessage("odom", odometry_at(number), attachment, time.monotonic())


def received(*numbers: int) -> RobotState:
    state = RobotState()
    for number in numbers:
        state.process(received_message(number))
    return state


def test_listen_reports_that_the_daemon_has_ended() -> None:
    endpoint, state = free_endpoint(), received(1)
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as robot:
        robot.on_alive(state.set_alive)
        wait_until(lambda: state.alive is True)
        bus.close()
        wait_until(lambda: state.alive is False)
    state._arrivals_s[-1] -= 10
    assert "its daemon has ended" in state.state and state.state in next(pose_lines("omnid", state))


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_table_holds_no_control_characters_of_messages() -> None:
    state = received(1, 2)
    evil = [DiagnosticStatus(WHEELS, 2, "\x1b[2J\nhello", {"sent": "4"}), DiagnosticStatus(BUS, 0, "", {})]
    state.process(ReceivedMessage("status", codec.diagnostics_cdr(1, evil), b"", 0.0))
    with contextlib.redirect_stdout(Terminal()) as terminal:
        print_state("omnid", state)
    shown = terminal.getvalue()
    assert shown.count("\x1b[") == 2 and "wheels" in shown and "hello" in shown
    assert len(shown.splitlines()) == 6 and "1 sigma 1.0 mm" in shown
    assert shown.index("wheels") < shown.index("bus"), "the error comes first"
    assert list(status_table("omnid", RobotState())) == ["omnid: no pose yet: no robot of this name is there"]


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
def test_a_stop_gets_through_when_all_sessions_are_in_use(tmp_path: Path) -> None:
    endpoint, stopped, few = free_endpoint(), [False], tmp_path / "few.json5"
    few.write_text("{transport: {unicast: {max_sessions: 4}}}")
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,), config=str(few)))) as bus:
        commands: list[str] = []

        def execute(request: Request) -> None:
            commands.append(request.topic)
            stopped[0] = request.topic == "cmd/stop"

        bus.subscribe_commands(execute, lambda: stopped[0])
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

        bus.subscribe_commands(execute)
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
    monkeypatch.setattr(robot_state, "SILENCE_S", 0.5)
    endpoint = free_endpoint()
    shown: list[NavigationReport] = []
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        publish_driving(bus, COMMAND_NS)
        with Robot("omnid", endpoint) as robot, pytest.raises(OmnidError, match="silent") as caught:
            shown.extend(robot_state.reports_of(robot, COMMAND_NS))
    assert [report.state for report in shown] == ["driving"]
    assert "it drives on (`omnid stop`" in str(caught.value)


def publish_driving(bus: Bus, command_ns: int) -> None:
    """Publish a report of a drive that a request with this stamp began."""
    values = {str(Key.STATE): "driving", "command_ns": str(command_ns)}
    entry = DiagnosticStatus(NAVIGATION, 0, "", values)
    bus.publish("navigation", codec.diagnostics_cdr(time.time_ns(), [entry]))


def test_a_drive_that_another_request_replaces_has_ended() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        publish_driving(bus, COMMAND_NS)
        with Robot("omnid", endpoint) as robot:
            stamps_ns = []
            for report in robot_state.reports_of(robot, COMMAND_NS):
                stamps_ns.append(report.command_ns)
                publish_driving(bus, COMMAND_NS + 1)
    assert (stamps_ns[0], stamps_ns[-1]) == (COMMAND_NS, COMMAND_NS + 1)


@pytest.mark.hazard("H25")
@pytest.mark.parametrize("is_answered", [True, False])
@pytest.mark.parametrize(("words", "number"), [(GOTO, signal.SIGINT), (REPEAT, signal.SIGHUP)])
def test_a_drive_is_cancelled_when_its_command_is_ended(
    words: tuple[str, ...], number: signal.Signals, is_answered: bool
) -> None:
    """By Ctrl-C, by its terminal that closes, or by a script; also while the robot has not yet answered."""
    endpoint, asked, cancelled = free_endpoint(), list[str](), list[str]()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:

        def execute(request: Request) -> None:
            if request.topic == NAVIGATION_TOPIC:
                cancelled.append(string_from_cdr(request.payload))
                bus.answer({request.id: Answer(True, "cancelled")})
                return
            if is_answered:
                bus.answer({request.id: Answer(True, "it drives")})
            asked.append(request.topic)

        bus.subscribe_commands(execute)
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


def test_a_route_that_is_too_short_is_taught_on() -> None:
    endpoint, asked = free_endpoint(), list[str]()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:

        def execute(request: Request) -> None:
            asked.append(string_from_cdr(request.payload))
            bus.answer({request.id: Answer(asked != ["teach hall", "finish"], "too short")})

        bus.subscribe_commands(execute)
        command = [sys.executable, "-c", HEARS_ALL, "route", "teach", "hall", "--connect", endpoint]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdin is not None and process.stdout is not None
            for line in ("records hall: drive it; Enter writes it, Ctrl-C drops it\n", "too short\n"):
                assert process.stdout.readline() == line
                print(file=process.stdin, flush=True)
            assert process.communicate(timeout=30.0)[0] == "hall is written\n"
    assert asked == ["teach hall", "finish", "finish"] and process.returncode == 0


LIMITS = VelocityLimits(velocity_mps=1.0, yaw_rate_radps=2.0)
UP = b"\x1b[A"


@pytest.fixture
def stick() -> Stick:
    return Stick(LIMITS, share=0.5)


def test_a_motion_lasts_as_long_as_its_key_is_repeated_at_a_share_of_the_limits(stick: Stick) -> None:
    assert stick.twist(0.0) == (0.0, 0.0) and not stick.is_moving(0.0)
    stick.press(UP, 10.0)
    assert stick.twist(10.0 + HOLD_S) == (0.5, 0.0)
    assert stick.twist(10.01 + HOLD_S) == (0.0, 0.0)
    assert stick.is_moving(10.0 + 2 * HOLD_S) and not stick.is_moving(10.01 + 2 * HOLD_S)
    stick.press(b"+" * 50 + UP, 20.0)
    assert stick.twist(20.0) == (1.0, 0.0)
    stick.press(b"-" * 50, 20.0)
    assert 0.0 < stick.twist(20.0)[0] <= 0.1
    stick.press(UP + b"a q", -math.inf)  # typed while it connected: motions are over
    assert stick.arm_asked and stick.stop_asked and stick.quit and not stick.is_moving(0.0)


@pytest.mark.parametrize("key", [b" ", b"x", b"\x1b[1;2A"])
def test_any_other_key_ends_the_motion_and_means_nothing_else(stick: Stick, key: bytes) -> None:
    stick.press(UP + key, 0.0)
    assert stick.twist(0.0) == (0.0, 0.0) and stick.is_moving(0.0)
    assert stick.stop_asked == (key == b" ") and not (stick.arm_asked or stick.quit) and stick.share == 0.5
    stick.press(b" ", 0.1)
    assert stick.stop_asked, "also after the first part of a key"


@pytest.mark.parametrize("parts", [(b"\x1b", b"[A"), (b"\x1bO", b"A")])
def test_an_arrow_that_comes_in_parts_means_nothing(stick: Stick, parts: tuple[bytes, ...]) -> None:
    for part in parts:
        stick.press(part, 0.0)
    assert stick.twist(0.0) == (0.0, 0.0)
    assert not (stick.arm_asked or stick.quit or stick.stop_asked)
