"""`omnid goto` with the daemon of `omnid simulate`, in odom and, after a restart, in the map that it has saved."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from calib import se3
from omnid.cli import main
from omnid.client import Robot
from omnid.errors import OmnidError
from omnid.formats.tum import read_tum
from tests.ports import free_port
from tests.replay.live import started
from tests.waiting import wait_until

GOAL = (0.6, 0.1, 45.0)  # m, m, deg
NEAR_M, NEAR_DEG = 0.05, 2.0


def takes_requests(port: int) -> bool:
    try:
        with Robot(connect=(f"tcp/127.0.0.1:{port}",)) as robot:
            return "no pose yet" not in robot.driver().navigate("resume").text
    except OmnidError:
        return False


@pytest.mark.slow
def test_goals_in_odom_and_in_the_saved_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port, truth = free_port(), tmp_path / "truth.tum"
    connect = ["--connect", f"tcp/127.0.0.1:{port}"]
    command = [
        *(sys.executable, "-m", "omnid", "simulate", "room", "--no-people", "--size", "320"),
        *("--truth", str(truth)),
        *("--map", str(tmp_path / "site.omap")),
        *("--set", f'bus.listen=["tcp/127.0.0.1:{port}"]'),
        *("--set", "controller.collision.unknown=slow"),
    ]  # such small images show little of the floor
    goals: dict[str, list[tuple[str, ...]]] = {"odom": [("0.8", "0"), ("0", "0", "0")], "map": [tuple(map(str, GOAL))]}
    for frame, poses in goals.items():
        with started(command, port) as daemon:
            wait_until(lambda: takes_requests(port), "the navigation")
            if frame == "odom":
                assert main(["goto", "1", "0", *connect]) == 2
                assert "not armed" in capsys.readouterr().err
                assert main(["arm", *connect]) == 0
                assert main(["goto", "1", "0", "--frame", "map", *connect]) == 2
                assert "not localised in a map" in capsys.readouterr().err
            for pose in poses:
                # A busy computer may stop the simulated motor controller for a moment, which disarms.
                wait_until(
                    lambda pose=pose: (
                        main(["arm", *connect]) == 0 and main(["goto", *pose, "--frame", frame, *connect]) == 0  # noqa: B023
                    ),
                    "the goal",
                )
            assert "reached" in capsys.readouterr().out
            assert daemon.end()[0] == 0
    end = read_tum(truth).T[-1]
    assert math.dist(end[:2, 3], GOAL[:2]) < NEAR_M
    assert math.degrees(float(se3.yaw(end))) == pytest.approx(GOAL[2], abs=NEAR_DEG)
