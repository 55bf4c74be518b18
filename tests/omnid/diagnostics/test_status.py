"""What a live daemon says of itself, part by part."""

from __future__ import annotations

import threading
import time
from typing import Any

import cv2
import numpy as np
import pytest

from calib import se3
from calib.rig import Rig
from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera, Frame
from drivers.motor import MotorStatus, VelocityCommand
from omnid.config import PairConfig
from omnid.controller.controller import Controller
from omnid.controller.statistics import ControllerStatistics
from omnid.core.control.control_law import ControllerSettings, TimedSetpoint
from omnid.core.control.heading_controller import Setpoint
from omnid.diagnostics.latency import Latency
from omnid.diagnostics.run_statistics import RunStatistics
from omnid.diagnostics.status import SILENT_S, StatusReport, StatusSources, StatusTick
from omnid.engine.telemetry import StageStats, Telemetry
from omnid.messages import OdometryUpdate
from omnid.stages.lockstep_drive import controller_pose
from omnid.stages.synchronise import Synchronise
from omnid.transport.codec import ERROR, OK, STALE, WARN, DiagnosticStatus, diagnostics_cdr
from omnid.transport.commands import CommandReceiver
from tests.simulation import build

SIZE = 256
JPEG = cv2.imencode(".jpg", np.full((SIZE, SIZE), 90, np.uint8))[1].tobytes()


class Wheels:
    """A controller that takes everything."""

    fault = 0

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Taken."""
        return MotorStatus(0.0, 0.0, 0.0, False, self.fault, 12.0)

    def close(self) -> None:
        """Done."""


class Daemon:
    """The parts that are asked."""

    def __init__(self, rig: Rig) -> None:
        self.telemetry, self.tally, self.latency = Telemetry(), RunStatistics(), Latency()
        self.stages = [self.telemetry.add(StageStats(name)) for name in ("stereo", "motor")]
        self.cameras: dict[Camera, CameraState] = {"lower": CameraState(), "upper": CameraState()}
        self.pair = Synchronise(rig, PairConfig())
        self.wheels = Wheels()
        self.controller = Controller(self.wheels, ControllerSettings(), 0.05)
        self.logbook = ControllerStatistics(self.stages[1])
        self.commands = CommandReceiver(self._take, lambda: self.controller.stop(time.monotonic_ns()), 0.5)
        self.report = StatusReport(
            StatusSources(
                self.telemetry,
                self.cameras,
                self.pair,
                self.tally,
                self.latency.to_pose,
                self.logbook,
                self.commands,
                frozenset({"motor"}),
            )
        )

    def _take(self, setpoint: Setpoint, arrival_ns: int) -> None:
        self.controller.set_command(TimedSetpoint(arrival_ns, setpoint))

    def asked(self) -> dict[str, DiagnosticStatus]:
        """All that is said, by name, after it has proved fit for the wire."""
        statuses = self.report()
        diagnostics_cdr(time.time_ns(), statuses)
        return {status.name.removeprefix("omnid: "): status for status in statuses}

    def shoot(self, *cameras: Camera, age_s: float = 0.0, data: bytes = JPEG) -> None:
        for camera in cameras:
            self.cameras[camera].status = "streaming"
            self.cameras[camera].frames += 1
            self.pair.process(Frame(0, time.monotonic_ns() - round(age_s * 1e9), camera, "jpeg", data))

    def pose(self, state: str = "tracking", age_s: float = 0.0) -> None:
        depth: Any = None
        odometry = OdometryUpdate(0, time.monotonic_ns() - round(age_s * 1e9), se3.transform(np.eye(3), [0, 0, 0]),
                            np.eye(6), np.zeros(6), np.eye(6), state, 0, 80, 99, depth)
        self.tally.process(odometry)
        self.latency.process(odometry)
        self.controller.set_pose(controller_pose(odometry, np.eye(4)))

    def tick(self) -> None:
        self.logbook.add(self.controller.tick())


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build("two_walls", seed=3, size=SIZE, pairs=2).rig


@pytest.fixture
def daemon(rig: Rig) -> Daemon:
    return Daemon(rig)


def test_a_daemon_that_has_seen_nothing(daemon: Daemon) -> None:
    said = daemon.asked()
    assert (said["odometry"].level, said["odometry"].message) == (STALE, "no pose yet")
    assert said["pairing"].message == "no images of the lower and the upper camera"
    assert said["wheels"].message == "no command" and said["wheels"].level == OK
    assert said["stage stereo"].values["dropped"] == "0" and said["stage motor"].values["missed"] == "0"


@pytest.mark.parametrize(("state", "level"), [("tracking", OK), ("degraded", WARN), ("lost", ERROR)])
def test_states_of_the_odometry(daemon: Daemon, state: str, level: int) -> None:
    daemon.pose(state)
    said = daemon.asked()["odometry"]
    assert (said.level, said.message) == (level, state) and said.values["landmarks"] == "80 of 99"
    assert 0.0 <= float(said.values["capture_to_pose_max_ms"]) < 1e5


def test_an_old_pose_is_stale_whatever_its_state(daemon: Daemon) -> None:
    daemon.pose(age_s=SILENT_S + 0.5)
    said = daemon.asked()["odometry"]
    assert said.level == STALE and said.message.startswith("no pose for 1.5")


def test_cameras_in_step(daemon: Daemon) -> None:
    daemon.asked()
    daemon.shoot("lower", "upper")
    said = daemon.asked()
    pairing = said["pairing"]
    assert (pairing.level, pairing.message, pairing.values["pairs"]) == (OK, "in step", "1")
    assert {said[f"{name} camera"].level for name in ("lower", "upper")} == {OK}
    assert said["lower camera"].message == "streaming" and float(said["lower camera"].values["rate_hz"]) > 0


def test_a_camera_that_says_nothing_is_named(daemon: Daemon) -> None:
    daemon.shoot("lower")
    daemon.shoot("upper", age_s=SILENT_S + 2)
    said = daemon.asked()
    assert (said["pairing"].level, said["pairing"].message) == (WARN, "no images of the upper camera")
    assert said["upper camera"].level == ERROR and said["upper camera"].message.startswith("no image for 3.0")
    assert said["lower camera"].level == OK


def test_a_lost_camera_tells_why(daemon: Daemon) -> None:
    daemon.shoot("lower", "upper")
    daemon.cameras["lower"].status, daemon.cameras["lower"].problem = "lost", "it was unplugged"
    said = daemon.asked()["lower camera"]
    assert (said.level, said.message) == (ERROR, "it was unplugged")


def test_images_that_never_meet_and_images_that_are_none(daemon: Daemon) -> None:
    daemon.asked()
    daemon.shoot("lower")
    daemon.shoot("upper", age_s=0.3)
    assert "pair.tolerance_ms" in daemon.asked()["pairing"].message
    daemon.shoot("lower", "upper", data=b"no image")
    said = daemon.asked()["pairing"]
    assert said.level == WARN and "cannot be decoded" in said.message and said.values["broken"] == "2"


def test_a_stage_tells_what_a_message_takes_and_what_of_it_is_its_own(daemon: Daemon) -> None:
    daemon.stages[0].timed(lambda: time.sleep(0.02))
    values = daemon.asked()["stage stereo"].values
    assert float(values["work_p50_ms"]) >= 19 and float(values["cpu_p50_ms"]) < float(values["work_p50_ms"]) / 2


def test_wheels(daemon: Daemon) -> None:
    daemon.pose()
    daemon.controller.set_command(TimedSetpoint(time.monotonic_ns(), Setpoint(0.2, None)))
    daemon.tick()
    said = daemon.asked()["wheels"]
    assert (said.level, said.message) == (OK, "driving") and said.values["sent"] == "1"
    assert "capture_to_wheel_p50_ms" in said.values and "tick_late_p99_ms" in said.values
    daemon.pose("lost")
    daemon.tick()
    said = daemon.asked()["wheels"]
    assert (said.level, said.message) == (WARN, "the pose is lost") and said.values["stopped, the pose is lost"] == "1"
    daemon.wheels.fault = 7
    daemon.tick()
    said = daemon.asked()["wheels"]
    assert said.level == ERROR and said.values["fault"] == "7"


def test_refused_commands_are_told_by_reason(daemon: Daemon) -> None:
    for payload in (b"", b"x" * 5000):
        daemon.commands.receive("cmd/twist", payload)
    values = daemon.asked()["wheels"].values
    assert values["refused, malformed"] == values["refused, too long"] == "1" and values["commands"] == "0"


def test_reports_bear_what_other_threads_do_meanwhile(daemon: Daemon) -> None:
    """New reasons appear while the old ones are told."""
    halt = threading.Event()

    def meddle() -> None:
        number = 0
        while not halt.is_set():
            number = (number + 1) % 300
            if not number:
                daemon.commands.refused.clear()
            daemon.commands.refused[f"reason {number}"] += 1

    thread = threading.Thread(target=meddle)
    thread.start()
    try:
        for _ in range(300):
            daemon.report()
    finally:
        halt.set()
        thread.join()


def test_the_tick_hands_the_report_to_everybody(daemon: Daemon) -> None:
    heard: list[list[DiagnosticStatus]] = []
    StatusTick(daemon.report, heard.append, heard.append)()
    assert len(heard) == 2 and heard[0] is heard[1] and heard[0][0].name == "omnid: odometry"
