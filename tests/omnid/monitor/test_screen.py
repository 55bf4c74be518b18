"""A robot's state in the terminal."""

from __future__ import annotations

import io
import time

import numpy as np
import pytest

from omnid.monitor.robot_state import ReceivedMessage, RobotState
from omnid.monitor.screen import Screen, load_line, load_table, status_table, summary_line
from omnid.transport import codec
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import BUS, SIMULATION, THREADS, WHEELS, Key
from tests.omnid.monitor.test_follow import received


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_table_holds_no_control_characters_of_messages() -> None:
    state = received(1, 2)
    evil = [
        DiagnosticStatus(WHEELS, 2, "\x1b[2J\nhello", {"sent": "4"}),
        DiagnosticStatus(BUS, 0, "", {}),
    ]
    state.process(ReceivedMessage(time.time_ns(), "status", codec.diagnostics_cdr(1, evil), b""))
    terminal = Terminal()
    Screen("omnid", terminal).show(state)
    shown = terminal.getvalue()
    assert shown.count("\x1b[") == 2 and "wheels" in shown and "hello" in shown
    assert len(shown.splitlines()) == 6 and "1 sigma 1.0 mm" in shown
    assert shown.index("wheels") < shown.index("bus"), "the error comes first"
    assert summary_line("omnid", RobotState()) == "omnid: no pose yet"
    assert list(status_table("omnid", RobotState(), 0)) == ["omnid: no pose yet"]


@pytest.mark.parametrize(("columns", "lines"), [(80, 24), (60, 20), (20, 3), (1, 1)])
def test_the_table_fits_the_terminal(monkeypatch: pytest.MonkeyPatch, columns: int, lines: int) -> None:
    state = received(1, 2)
    many = [DiagnosticStatus(f"omnid: part {n}", n % 3, "a message " * 10, {"key": "value" * 30}) for n in range(40)]
    state.process(ReceivedMessage(time.time_ns(), "status", codec.diagnostics_cdr(1, many), b""))
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("LINES", str(lines))
    terminal = Terminal()
    Screen("omnid", terminal).show(state)
    shown = terminal.getvalue().removeprefix("\x1b[H\x1b[J").splitlines()
    assert len(shown) <= max(2, lines - 1) and max(map(len, shown)) <= columns
    assert "omnid: tracking".startswith(shown[0][: columns - 1][:15])
    assert lines < 20 or "more; make the window higher" in shown[-1]


def test_the_load_is_shown_by_threads() -> None:
    state = RobotState()
    assert load_line("rover", state) == "rover: no load of its threads yet"
    values = {"all": "0.500", "bus": "0.104", "odometry": "0.396", "words": "none", "\x1b[2J": "0.001"}
    state.statuses[THREADS] = DiagnosticStatus(THREADS, 0, "", values)
    assert list(load_table("rover", state)) == [
        "rover: 50.0 % of a core",
        "   39.6 %  odometry",
        "   10.4 %  bus",
        "    0.1 %  \\x1b[2J",
    ]
    assert load_line("rover", state) == "rover: 50.0 % of a core, 39.6 % odometry, 10.4 % bus, 0.1 % \\x1b[2J"
    out = io.StringIO()
    Screen("rover", out, shows_load=True).show(state)
    assert out.getvalue() == load_line("rover", state) + "\n"


def test_poses_of_a_simulated_clock_have_no_age() -> None:
    state = RobotState()

    def receive(number: int) -> None:
        payload = codec.odometry_cdr(time.time_ns(), np.eye(4), 1e-6 * np.eye(6), np.zeros(6), np.eye(6))
        attachment = PoseAttachment(number, "tracking", 0, 50, 60, time.time_ns()).to_bytes()
        state.process(ReceivedMessage(time.time_ns(), "odom", payload, attachment))

    receive(1)
    assert state.age.count == 1
    pace = DiagnosticStatus(SIMULATION, 0, "", {Key.REAL_TIME_FACTOR: "0.50"})
    state.process(ReceivedMessage(time.time_ns(), "status", codec.diagnostics_cdr(10**18, [pace]), b""))
    receive(2)
    assert state.age.count == 0 and "0.50 x real time" in summary_line("rover", state)
