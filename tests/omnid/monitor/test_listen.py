"""`omnid listen`: in a process of its own, and the state of a robot as it is shown."""

from __future__ import annotations

import contextlib
import io
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import count

import numpy as np
import pytest

from calib import se3
from omnid.client import Robot
from omnid.monitor.listen import pose_lines, print_state, status_table
from omnid.monitor.robot_state import ReceivedMessage, RobotState
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus, PoseAttachment
from omnid.transport.status_names import BUS, WHEELS
from tests.omnid.transport.bus_fixtures import DEADLINE_S, free_endpoint
from tests.replay.command import Command
from tests.waiting import wait_until

pytestmark = pytest.mark.usefixtures("default_signals")


@contextlib.contextmanager
def listening(*words: object) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-m", "omnid", "listen", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def odometry_at(number: int) -> bytes:
    T = se3.transform(se3.rotation_exp([0.0, 0.0, 0.1]), [0.5, 0.25, 0.0])
    return codec.odometry_cdr(10**18 + number, T, 1e-6 * np.eye(6), np.zeros(6), np.eye(6))


def publish(bus: Bus, number: int) -> None:
    bus.publish("odom", odometry_at(number), PoseAttachment(number, "tracking", 0, 50, 60, time.time_ns()).to_bytes())
    bus.publish("/tf", codec.transform_cdr(10**18, []))
    bus.publish("status", codec.diagnostics_cdr(10**18, [DiagnosticStatus(WHEELS, 1, "no command", {"sent": "4"})]))


def publish_until_it_ends(
    bus: Bus, process: subprocess.Popen[str], number_of_signal: signal.Signals | None = None
) -> tuple[str, str]:
    """Publish, and send the signal where there is one after 150 messages."""
    deadline_s = time.monotonic() + DEADLINE_S
    for number in count():
        publish(bus, number)
        time.sleep(0.01)
        if number == 150 and number_of_signal is not None:
            process.send_signal(number_of_signal)
        if process.poll() is not None:
            break
        assert time.monotonic() < deadline_s
    return process.communicate()


def test_prints_a_line_per_second() -> None:
    endpoint = free_endpoint()
    words = ("--robot", "rover", "--connect", endpoint, "--seconds", 2.2)
    with contextlib.closing(Bus(BusConfig(robot="rover", listen=(endpoint,)))) as bus, listening(*words) as it:
        out, err = publish_until_it_ends(bus, it)
    assert it.returncode == 0 and err == ""
    lines = out.splitlines()
    assert 2 <= len(lines) <= 3 and all(
        "x +0.500 y +0.250" in text and text.startswith("rover: tracking  ") for text in lines
    )
    assert "missed " in lines[-1] and "network " in lines[-1] and "\x1b" not in out


@pytest.mark.parametrize("number_of_signal", [signal.SIGINT, signal.SIGTERM])
def test_waits_for_the_robot_and_ends_with_a_signal(number_of_signal: signal.Signals) -> None:
    endpoint = free_endpoint()
    with listening("--connect", endpoint) as it:
        assert it.stderr is not None and endpoint in it.stderr.readline()
        with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
            out, err = publish_until_it_ends(bus, it, number_of_signal)
    assert it.returncode == 0 and "tracking" in out.splitlines()[-1] and err == ""


def test_a_signal_ends_the_wait_for_a_robot() -> None:
    with listening("--connect", free_endpoint()) as it:
        assert it.stderr is not None and "waiting" in it.stderr.readline()
        time.sleep(1.0)  # it tries again, and does not say so
        it.send_signal(signal.SIGTERM)
        out, err = it.communicate(timeout=DEADLINE_S)
    assert it.returncode == 1 and out.splitlines()[0] == "omnid: no pose yet" and err == ""


def test_a_wrong_name_is_answered_by_those_of_the_robots_there() -> None:
    endpoint = free_endpoint()
    idle = contextlib.closing(Bus(BusConfig(listen=(endpoint,), robot="hall/one")))
    with idle, listening("--connect", endpoint, "--seconds", 0.5) as it:
        out, _ = it.communicate(timeout=DEADLINE_S)
    assert it.returncode == 1 and out == "omnid: no pose yet (robots there: hall/one)\n"


@pytest.mark.parametrize(
    ("words", "expected"),
    [(("--seconds", "-1"), "--seconds"), (("--connect", "nonsense"), "bus.connect"), (("--robot", "a b"), "bus.robot")],
)
def test_refuses_invalid_options(words: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert expected in Command(capsys).refused("listen", *words)


def received_message(number: int) -> ReceivedMessage:
    attachment = PoseAttachment(number, "tracking", 0, 50, 60, time.time_ns()).to_bytes()
    return ReceivedMessage(time.time_ns(), "odom", odometry_at(number), attachment, time.monotonic_ns())


def received(*numbers: int) -> RobotState:
    state = RobotState()
    for number in numbers:
        state.process(received_message(number))
    return state


def test_tells_that_the_daemon_has_ended() -> None:
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
    state.process(ReceivedMessage(time.time_ns(), "status", codec.diagnostics_cdr(1, evil), b"", 0))
    terminal = Terminal()
    print_state("omnid", state, terminal)
    shown = terminal.getvalue()
    assert shown.count("\x1b[") == 2 and "wheels" in shown and "hello" in shown
    assert len(shown.splitlines()) == 6 and "1 sigma 1.0 mm" in shown
    assert shown.index("wheels") < shown.index("bus"), "the error comes first"
    assert list(status_table("omnid", RobotState())) == ["omnid: no pose yet"]
