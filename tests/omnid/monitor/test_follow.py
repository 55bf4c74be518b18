"""`omnid listen` in a process of its own, and what it keeps."""

from __future__ import annotations

import contextlib
import io
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from calib import se3
from omnid.formats.tum import read_tum
from omnid.monitor.robot_state import Inbox, ReceivedMessage, RobotState
from omnid.monitor.screen import Screen, line, table
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.pose_attachment import Note, note_bytes
from tests.omnid.transport.bus_fixtures import DEADLINE_S, free_endpoint
from tests.replay.command import Command, rows


@contextlib.contextmanager
def listening(*words: object) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen([sys.executable, "-m", "omnid", "listen", *map(str, words)], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def odometry_at(number: int) -> bytes:
    T = se3.transform(se3.rotation_exp([0.0, 0.0, 0.1]), [0.5, 0.25, 0.0])
    return codec.odometry_cdr(10**18 + number, T, 1e-6 * np.eye(6), np.zeros(6), np.eye(6))


def say(bus: Bus, number: int) -> None:
    bus.publish("odom", odometry_at(number), note_bytes(Note(number, "tracking", 0, 50, 60, time.time_ns())))
    bus.publish("/tf", codec.transform_cdr(10**18, []))
    bus.publish(
        "status", codec.diagnostics_cdr(10**18, [DiagnosticStatus("omnid: wheels", 1, "no command", {"sent": "4"})])
    )


def say_until_it_ends(bus: Bus, process: subprocess.Popen[str]) -> tuple[str, str]:
    deadline_s = time.monotonic() + DEADLINE_S
    for number in count():
        say(bus, number)
        time.sleep(0.01)
        if process.poll() is not None:
            break
        assert time.monotonic() < deadline_s
    return process.communicate()


def test_a_line_a_second_and_the_files(tmp_path: Path) -> None:
    endpoint, tum, log = free_endpoint(), tmp_path / "path.txt", tmp_path / "heard.mcap"
    with contextlib.closing(Bus(BusConfig(robot="rover", listen=(endpoint,)))) as bus:
        bus.tell("rig", "name = 'rig'")
        with listening("--robot", "rover", "--connect", endpoint, "--seconds", 2.2, "--tum", tum, "--mcap", log) as it:
            out, err = say_until_it_ends(bus, it)
    assert it.returncode == 0 and err == ""
    lines = out.splitlines()
    assert 2 <= len(lines) <= 3 and all(said.startswith("rover: tracking  x +0.500 y +0.250") for said in lines)
    assert "missed " in lines[-1] and "way " in lines[-1] and "\x1b" not in out
    assert len(rows(tum)) > 20 and np.allclose(read_tum(tum).T[:, 0, 3], 0.5)
    with AnyReader([log]) as reader:
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
        poses = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == "/rover/odom"]
    assert kinds == {"/rover/odom": "nav_msgs/msg/Odometry", "/tf": "tf2_msgs/msg/TFMessage",
                     "/rover/status": "diagnostic_msgs/msg/DiagnosticArray"}
    assert len(poses) > 20 and {pose.pose.pose.position.x for pose in poses} == {0.5}
    assert b"name = 'rig'" in log.read_bytes()


def test_it_waits_for_a_robot_that_is_not_there_and_ends_with_ctrl_c() -> None:
    endpoint = free_endpoint()
    with listening("--connect", endpoint) as it:
        assert it.stderr is not None and endpoint in it.stderr.readline()
        with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
            deadline_s = time.monotonic() + DEADLINE_S
            for number in count():
                say(bus, number)
                time.sleep(0.01)
                if number == 150:
                    it.send_signal(signal.SIGINT)
                if it.poll() is not None:
                    break
                assert time.monotonic() < deadline_s
            out, err = it.communicate()
    assert it.returncode == 0 and "tracking" in out.splitlines()[-1] and err == ""


def test_a_robot_that_says_nothing_is_told_by_the_exit_code() -> None:
    endpoint = free_endpoint()
    silent = contextlib.closing(Bus(BusConfig(listen=(endpoint,))))
    with silent, listening("--connect", endpoint, "--seconds", 0.5) as it:
        out, _ = it.communicate(timeout=DEADLINE_S)
    assert it.returncode == 1 and out == "omnid: no pose yet\n"


@pytest.mark.parametrize(("words", "told"), [
    (("--seconds", "-1"), "--seconds"),
    (("--connect", "nonsense"), "bus.connect"),
    (("--tum", "/nowhere/x"), "--tum"),
    (("--robot", "a b"), "bus.robot"),
])
def test_wrong_words_are_refused(words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert told in Command(capsys).refused("listen", *words)


def heard(*numbers: int) -> RobotState:
    found = RobotState()
    for number in numbers:
        note = note_bytes(Note(number, "tracking", 0, 50, 60, time.time_ns()))
        found.take(ReceivedMessage(time.time_ns(), "odom", odometry_at(number), note))
    return found


def test_what_was_left_out_is_counted_and_a_new_start_is_none() -> None:
    assert heard(1, 2, 5, 6).missed == 2
    assert heard(5, 6, 1, 2).missed == 0
    broken = heard(1)
    assert broken.take(ReceivedMessage(1, "odom", b"nonsense", b"")) is None and broken.broken == 1


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_a_table_that_nobody_can_talk_through() -> None:
    found = heard(1, 2)
    evil = [
        DiagnosticStatus("omnid: wheels", 2, "\x1b[2J\nhello", {"sent": "4"}),
        DiagnosticStatus("omnid: bus", 0, "", {}),
    ]
    found.take(ReceivedMessage(time.time_ns(), "status", codec.diagnostics_cdr(1, evil), b""))
    terminal = Terminal()
    Screen("omnid", terminal).show(found)
    shown = terminal.getvalue()
    assert shown.count("\x1b[") == 2 and "wheels" in shown and "hello" in shown
    assert len(shown.splitlines()) == 4 and "1 sigma 1.0 mm" in shown
    assert line("omnid", RobotState()) == "omnid: no pose yet" and list(table("omnid", RobotState(), 0)) == [
        "omnid: no pose yet"
    ]


def test_a_mailbox_forgets_the_oldest() -> None:
    box = Inbox()
    for number in range(2010):
        box.take(str(number), b"", b"")
    first = box.next(0.0)
    assert box.forgotten == 10 and first is not None and first.topic == "10"
