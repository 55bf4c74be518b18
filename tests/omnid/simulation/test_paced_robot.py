"""`omnid simulate` in its own time: a daemon that is slowed down loses nothing, and drives where it is told to.

The test stands for a busy computer: it stops the whole daemon again and again, for longer than its deadlines.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from omnid.cli import main
from omnid.client import Diagnostics, Robot
from omnid.formats.tum import read_tum
from omnid.transport.bus_config import BusConfig
from omnid.transport.status_names import SIMULATION, STAGE_PREFIX, WHEELS, Key
from tests.busy import stopped_by_turns
from tests.ports import free_port
from tests.replay.live import started
from tests.waiting import wait_until

STOPPED_S, RUNNING_S = 0.6, 0.3  # longer than the deadlines of poses and commands; share of a computer that is left
NEAR_M = 0.05
GOAL = ("0.3", "0.05")


def newest(port: int) -> Diagnostics:
    """Return a whole status of the daemon."""
    with (
        Robot(settings=BusConfig(connect=(f"tcp/127.0.0.1:{port}",))) as robot,
        robot.subscribe(Diagnostics) as statuses,
    ):
        while True:
            report = statuses.wait(20.0)
            assert report is not None
            if len(report.statuses) > 1:
                return report


def test_a_slowed_daemon_reaches_its_goal_and_loses_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port, truth = free_port(), tmp_path / "truth.tum"
    connect = ["--connect", f"tcp/127.0.0.1:{port}"]
    command = [
        *(sys.executable, "-m", "omnid", "simulate", "room", "--no-people", "--size", "320"),
        *("--truth", str(truth)),
        *("--set", f'bus.listen=["tcp/127.0.0.1:{port}"]'),
        *("--set", "live.status_s=0.2"),
        *("--set", "controller.collision.unknown=slow"),
    ]  # such small images show little of the floor
    with started(command, port) as daemon:
        wait_until(lambda: main(["arm", *connect]) == 0, "arming")
        assert [
            main(["goto", *words, *connect]) for words in (["0.2", "0", "--no-wait"], ["--pause"], ["--resume"])
        ] == [0, 0, 0]
        assert "paused by a request: `omnid goto --resume`" in capsys.readouterr().out
        with stopped_by_turns(daemon.process, RUNNING_S, STOPPED_S):
            reached = main(["goto", *GOAL, *connect])
        status = newest(port)
        with Robot(settings=BusConfig(connect=(f"tcp/127.0.0.1:{port}",))) as robot:
            clocks: list[bytes] = []
            robot.on_message(lambda _, payload, __: clocks.append(payload), "clock")
            wait_until(lambda: len(set(clocks)) > 2, "the simulated time on the bus")
        code, log = daemon.end()
    assert reached == 0, log
    # 1. Nothing was lost on the way, and no rule stopped the wheels.
    stages = {entry.name: entry.values for entry in status.statuses if entry.name.startswith(STAGE_PREFIX)}
    dropped = {name: values[Key.DROPPED] for name, values in stages.items() if Key.DROPPED in values}
    assert {f"{STAGE_PREFIX}bus", f"{STAGE_PREFIX}odometry"} <= set(dropped)
    lossy = {f"{STAGE_PREFIX}bus-status"}  # it comes by the time on the wall, and the newest counts
    assert {name for name, count in dropped.items() if count != "0"} <= lossy
    assert status.value(WHEELS, Key.ARMED) == "1"
    # 2. Its time went more slowly than that on the wall.
    assert 0 < float(status.value(SIMULATION, Key.REAL_TIME_FACTOR)) <= 1.0
    # 3. The robot stands at the goal, which is no drive that was cut short.
    assert "the command is stale" not in log
    assert code == 0 and "contacts with obstacles: 0" in log
    assert math.dist(read_tum(truth).T[-1, :2, 3], tuple(map(float, GOAL))) < NEAR_M
