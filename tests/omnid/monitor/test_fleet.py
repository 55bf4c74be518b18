"""`omnid listen --all`: several robots behind a router, one of which ends."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
import threading
import time
from typing import IO

import numpy as np
import zenoh

from calib import se3
from omnid.errors import OmnidError
from omnid.monitor.fleet import MAX_ROBOTS, FleetState, fleet_table, show
from omnid.monitor.robot_state import ReceivedMessage
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import MAP_FILE, ODOMETRY, WHEELS
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint, script

LIMIT_S = 120  # no table needs as long as that, even on a busy computer
NAMES = ("hall/one", "hall/two", "three")
ALL_THERE = "3 robots, 1 with warnings, 0 with errors or gone"
ONE_GONE = "3 robots, 1 with warnings, 1 with errors or gone"


def publish(bus: Bus, number: int, level: int = 0) -> None:
    T = se3.transform(se3.rotation_exp([0.0, 0.0, 0.1]), [0.5, -0.25, 0.0])
    bus.publish(
        "odom",
        codec.odometry_cdr(10**18 + number, T, 1e-6 * np.eye(6), np.zeros(6), np.eye(6)),
        PoseAttachment(number, "tracking", 0, 50, 60, time.time_ns()).to_bytes(),
    )
    bus.publish("status", codec.diagnostics_cdr(10**18, [DiagnosticStatus(WHEELS, level, "it is late", {})]))


def publish_until(stopped: threading.Event, buses: dict[str, Bus]) -> None:
    """Publish poses and states of all robots whose bus is open."""
    number = 0
    while not stopped.wait(0.05):
        number += 1
        for name, bus in buses.items():
            with contextlib.suppress(zenoh.ZError, OmnidError):  # the bus was closed in between
                publish(bus, number, level=int(name == "hall/two"))


def table_with(stream: IO[str], head: str) -> list[str]:
    """Return the robots' lines of the next table that begins with a head and in which each has a state."""
    for line in stream:
        if line.strip() == head:
            robots = [next(stream) for _ in range(1 + len(NAMES))][1:]
            if all(robot.split()[1] in {"tracking", "gone"} for robot in robots):
                return robots
    raise AssertionError(f"the command ended without {head!r}")


def test_shows_all_robots_behind_a_router_the_worst_first() -> None:
    endpoint = free_endpoint()
    with contextlib.ExitStack() as ends:
        ends.enter_context(script(ROUTER, endpoint))
        buses = {name: Bus(BusConfig(robot=name, listen=(), connect=(endpoint,))) for name in NAMES}
        for bus in buses.values():
            ends.callback(bus.close)
        process = subprocess.Popen(
            [sys.executable, "-m", "omnid", "listen", "--all", "--connect", endpoint, "--seconds", str(LIMIT_S)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        ends.callback(process.kill)
        stopped = threading.Event()
        ends.callback(stopped.set)
        publishing = threading.Thread(target=publish_until, args=(stopped, buses))
        publishing.start()
        assert process.stdout is not None
        shown = table_with(process.stdout, ALL_THERE)
        buses["three"].close()
        lines = table_with(process.stdout, ONE_GONE)
        stopped.set()
        publishing.join()
    assert [line.split()[0] for line in shown] == ["hall/two", "hall/one", "three"], shown
    assert [line.split()[0] for line in lines] == ["three", "hall/two", "hall/one"]
    assert "gone" in lines[0] and "it is late" in lines[1]
    assert lines[2].split()[1] == "tracking" and lines[2].split()[3:5] == ["+0.50", "-0.25"]


def test_the_number_of_robots_is_bounded_and_their_names_are_plain() -> None:
    fleet = FleetState()
    for number in range(3 * MAX_ROBOTS):
        fleet.process(ReceivedMessage(0, f"robot{number}/odom", b"", b""))
    assert len(fleet.robots) == MAX_ROBOTS and len(fleet.refused) == MAX_ROBOTS
    assert next(fleet_table(fleet.robots, len(fleet.refused), 3)) == (
        f"{MAX_ROBOTS} robots, 0 with warnings, {MAX_ROBOTS} with errors or gone; {MAX_ROBOTS} more than {MAX_ROBOTS} "
        "are left out; 3 messages dropped"
    )
    hostile = FleetState()
    hostile.process(ReceivedMessage(0, "\x1b[2J" + 300 * "x" + "/status", b"junk", b""))
    stream = io.StringIO()
    show(hostile, stream)
    assert "\x1b" not in stream.getvalue() and max(map(len, stream.getvalue().splitlines())) < 120


def test_a_robot_that_has_ended_takes_its_statuses_along() -> None:
    """Started again without map and wheels, it shows neither of before."""
    fleet, times_ns = FleetState(), iter(range(1, 9))
    good = DiagnosticStatus(ODOMETRY, 0, "tracking", {})
    full = DiagnosticStatus(MAP_FILE, 2, "m.omap cannot be written: disk full", {})

    def report(*statuses: DiagnosticStatus) -> None:
        message = codec.diagnostics_cdr(10**18, statuses)
        fleet.process(ReceivedMessage(next(times_ns), "rover/status", message, b""))

    def come_and_go(*alive: bool) -> None:
        for there in alive:
            fleet.note_alive("rover", there)
        fleet.take_alive()

    come_and_go(True)
    report(good, full, DiagnosticStatus(WHEELS, 0, "driving", {"armed": "1"}))
    assert set(fleet.robots["rover"].statuses) == {ODOMETRY, MAP_FILE, WHEELS}
    come_and_go(True)
    assert set(fleet.robots["rover"].statuses) == {ODOMETRY, MAP_FILE, WHEELS}
    come_and_go(False)
    assert not fleet.robots["rover"].statuses
    report(full)  # sent before it ended
    assert not fleet.robots["rover"].statuses
    come_and_go(True)
    report(good, full)
    come_and_go(False, True)
    report(good)
    assert set(fleet.robots["rover"].statuses) == {ODOMETRY}
    assert "disk full" not in "".join(fleet_table(fleet.robots))


def test_options_of_one_robot_are_refused() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "omnid", "listen", "--all", "--robot", "one"], capture_output=True, text=True
    )
    assert done.returncode == 2 and "--robot does not go with it" in done.stderr


def test_a_narrow_terminal_shows_what_is_wrong() -> None:
    fleet = FleetState()
    status = codec.diagnostics_cdr(10**18, [DiagnosticStatus(WHEELS, 2, "the motor does not answer", {})])
    fleet.process(ReceivedMessage(time.time_ns(), "rover/status", status, b""))
    wide, narrow = (list(fleet_table(fleet.robots, narrow=narrow)) for narrow in (False, True))
    assert "x m" in wide[1] and "x m" not in narrow[1]
    assert narrow[2][:80].endswith("wheels: the motor does not answer")
