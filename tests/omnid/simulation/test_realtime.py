"""The simulated robot in real time: what is sent to its serial port moves what its cameras see."""

from __future__ import annotations

import time
from contextlib import closing
from itertools import islice
from threading import Thread

import pytest

from drivers.cameras.log_camera import LogClock
from drivers.frame import Frame
from drivers.motor import VelocityCommand
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.protocols.line_protocol import LineProtocol
from drivers.motors.serial_motor import SerialMotor
from omnid.cli import main
from omnid.simulation.realtime import RealtimeRobot
from omnid.simulation.robot import make_robot
from omnid.simulation.world_file import load_world

SIZE, FRAMES = 96, 12
PERIOD_NS = 100_000_000


def test_commands_on_the_serial_port_move_the_cameras() -> None:
    drive, clock = DifferentialDrive(), LogClock()
    frames: dict[str, list[Frame]] = {"lower": [], "upper": []}
    with closing(RealtimeRobot(load_world("room", 1), make_robot(SIZE), "line", drive)) as robot:
        cameras = {name: robot.open_camera(name, clock) for name in ("lower", "upper")}  # type: ignore[arg-type]
        threads = [
            Thread(target=lambda name=name, camera=camera: frames[name].extend(islice(camera.frames(), FRAMES)))
            for name, camera in cameras.items()
        ]
        with closing(SerialMotor(robot.port, LineProtocol(drive), timeout_s=1.0, watchdog_ms=2000)) as motor:
            for thread in threads:
                thread.start()
            while any(thread.is_alive() for thread in threads):
                motor.send(VelocityCommand(0, 0.4, 0.0, 0.0))
                time.sleep(0.02)
        truth = list(robot.drive.truth.items())
    start_ns = clock.epoch_ns()
    for taken in frames.values():
        assert all((frame.stamp_ns - start_ns) % PERIOD_NS == 0 for frame in taken)
        assert (taken[0].data != taken[-1].data).mean() > 0.5  # type: ignore[union-attr]
    assert [stamp for stamp, _ in truth] == [frame.stamp_ns for frame in frames["lower"]]
    assert truth[-1][1][0] - truth[0][1][0] > 0.1
    assert robot.drive.contacts == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["castle"], "world 'castle' is not known"),
        (["room", "--size", "9"], "--size 9: expected 64 to 2048 px"),
        (["room", "--light", "-1"], "brightness -1"),
        (["room", "--seed", "-1"], "--seed -1: expected 0 or more"),
        (["room", "--truth", "/none/truth.txt"], "--truth"),
    ],
)
def test_wrong_options_are_one_line(capsys: pytest.CaptureFixture[str], arguments: list[str], message: str) -> None:
    assert main(["simulate", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
