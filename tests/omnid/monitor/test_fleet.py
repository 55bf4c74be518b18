"""`omnid listen --all`: several robots behind a router, one of which ends."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
import time

import numpy as np

from calib import se3
from omnid.monitor.fleet import MAX_ROBOTS, FleetState, fleet_table, show
from omnid.monitor.robot_state import ReceivedMessage
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.status_names import WHEELS
from tests.omnid.transport.bus_fixtures import ROUTER, free_endpoint, script


def publish(bus: Bus, number: int, level: int = 0) -> None:
    T = se3.transform(se3.rotation_exp([0.0, 0.0, 0.1]), [0.5, -0.25, 0.0])
    bus.publish("odom", codec.odometry_cdr(10**18 + number, T, 1e-6 * np.eye(6), np.zeros(6), np.eye(6)),
                PoseAttachment(number, "tracking", 0, 50, 60, time.time_ns()).to_bytes())
    bus.publish("status", codec.diagnostics_cdr(10**18, [DiagnosticStatus(WHEELS, level, "it is late", {})]))


def test_shows_all_robots_behind_a_router_the_worst_first() -> None:
    endpoint = free_endpoint()
    with contextlib.ExitStack() as ends:
        ends.enter_context(script(ROUTER, endpoint))
        buses = {name: Bus(BusConfig(robot=name, listen=(), connect=(endpoint,)))
                 for name in ("hall/one", "hall/two", "three")}
        for bus in buses.values():
            ends.callback(bus.close)
        process = subprocess.Popen(
            [sys.executable, "-m", "omnid", "listen", "--all", "--connect", endpoint, "--seconds", "8"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        ends.callback(process.kill)
        number, ended = 0, False
        start_s = time.monotonic()
        while process.poll() is None:
            number += 1
            if not ended and time.monotonic() > start_s + 4.0:
                buses["three"].close()
                ended = True
            for name, bus in buses.items():
                if not (ended and name == "three"):
                    publish(bus, number, level=int(name == "hall/two"))
            time.sleep(0.05)
        out, err = process.communicate()
        assert process.returncode == 0, err
    head, _, *lines = out.strip().splitlines()[-5:]
    assert head == "3 robots, 1 with warnings, 1 with errors or gone"
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
        "are left out; 3 messages dropped")
    hostile = FleetState()
    hostile.process(ReceivedMessage(0, "\x1b[2J" + 300 * "x" + "/status", b"junk", b""))
    stream = io.StringIO()
    show(hostile, stream)
    assert "\x1b" not in stream.getvalue() and max(map(len, stream.getvalue().splitlines())) < 120


def test_options_of_one_robot_are_refused() -> None:
    done = subprocess.run([sys.executable, "-m", "omnid", "listen", "--all", "--robot", "one"], capture_output=True,
                          text=True)
    assert done.returncode == 2 and "--robot does not go with it" in done.stderr


def test_a_narrow_terminal_shows_what_is_wrong() -> None:
    fleet = FleetState()
    status = codec.diagnostics_cdr(10**18, [DiagnosticStatus(WHEELS, 2, "the motor does not answer", {})])
    fleet.process(ReceivedMessage(time.time_ns(), "rover/status", status, b""))
    wide, narrow = (list(fleet_table(fleet.robots, narrow=narrow)) for narrow in (False, True))
    assert "x m" in wide[1] and "x m" not in narrow[1]
    assert narrow[2][:80].endswith("wheels: the motor does not answer")
