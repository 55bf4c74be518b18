"""Entries of the status of all parts, and the summary of a run."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

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
from omnid.controller.link import ControllerStatistics
from omnid.core.control.arming import ArmRequest, TimedSetpoint
from omnid.core.control.control_law import ControllerSettings
from omnid.core.control.heading_controller import Setpoint
from omnid.core.stereo.tiles import ALL_LIVE, TILE_COLUMNS, TILE_ROWS, TileStates
from omnid.diagnostics.status import RunStatistics, StatusCollector, image_stats, wheel_stats
from omnid.engine.graph import StageStats
from omnid.engine.robot_clock import RobotClock
from omnid.messages import OdometryUpdate, StereoDepth
from omnid.sinks.drive import controller_pose
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import TrackingState
from omnid.transport import codec
from omnid.transport.codec import ERROR, OK, STALE, WARN, DiagnosticStatus, diagnostics_cdr
from omnid.transport.commands import CommandReceiver, Freshness
from omnid.transport.status_names import IMAGES, REMEDIES, TIMEOUT_S, WHEELS, Key, entry, short_name
from omnid.transport.topics import Request
from tests.omnid.sinks.test_recorder import small_depth
from tests.simulation import build

SIZE = 256
JPEG = cv2.imencode(".jpg", np.full((SIZE, SIZE), 90, np.uint8))[1].tobytes()


class AcceptingMotor:
    """A motor driver that accepts all commands."""

    fault = 0

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Accept a command."""
        return MotorStatus(0.0, 0.0, 0.0, False, self.fault, 12.0)

    def close(self) -> None:
        """Do nothing."""


class Daemon:
    """The parts of a daemon whose status is collected."""

    def __init__(self, rig: Rig, pairing: PairConfig | None = None) -> None:
        self.statistics = RunStatistics(RobotClock())
        self.stages = {name: StageStats() for name in ("pair", "motor")}
        self.cameras: dict[Camera, CameraState] = {"lower": CameraState(), "upper": CameraState()}
        self.pair = Synchronise(rig, pairing or PairConfig())
        self.motor = AcceptingMotor()
        self.controller = Controller(self.motor, ControllerSettings().without_obstacles, 0.05)
        self.controller_statistics = ControllerStatistics(self.stages["motor"])
        self.commands = CommandReceiver(Freshness(0.5), controller=self)
        self.report = StatusCollector(
            self.stages,
            self.cameras,
            self.pair,
            self.statistics,
            {WHEELS: partial(wheel_stats, self.controller_statistics, self.commands)},
        )

    def send(self, given: TimedSetpoint | ArmRequest) -> None:
        self.controller.take(given)

    def stop(self) -> None:
        self.controller.stop(time.monotonic_ns())

    def touch(self, contact: str, *, holds: bool) -> None:
        """Take a contact."""

    def collected(self) -> dict[str, DiagnosticStatus]:
        """Return all entries by short name, after encoding them."""
        statuses = self.report()
        diagnostics_cdr(time.time_ns(), statuses)
        return {short_name(status.name): status for status in statuses}

    def shoot(self, *cameras: Camera, age_s: float = 0.0, data: bytes = JPEG) -> None:
        stamp_ns = time.monotonic_ns() - round(age_s * 1e9)
        for camera in cameras:
            self.cameras[camera].status = "streaming"
            self.cameras[camera].frames += 1
            self.pair.process(Frame(0, stamp_ns, camera, "jpeg", data))

    def pose(self, state: str = "tracking", age_s: float = 0.0) -> None:
        odometry = OdometryUpdate(
            0,
            time.monotonic_ns() - round(age_s * 1e9),
            se3.transform(np.eye(3), [0, 0, 0]),
            np.eye(6),
            np.zeros(6),
            np.eye(6),
            state,
            0,
            80,
            99,
            small_depth(),
        )
        self.statistics.process(odometry)
        self.controller.take(controller_pose(odometry, np.eye(4)))

    def tick(self) -> None:
        self.controller_statistics.add(self.controller.tick())


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build("two_walls", seed=3, size=SIZE, pairs=2).rig


@pytest.fixture
def daemon(rig: Rig) -> Daemon:
    return Daemon(rig)


@pytest.mark.parametrize(("state", "level"), [("tracking", OK), ("degraded", WARN), ("lost", ERROR)])
def test_the_level_follows_the_tracking_state(daemon: Daemon, state: str, level: int) -> None:
    daemon.pose(state)
    status = daemon.collected()["odometry"]
    assert (status.level, status.message) == (level, state)
    assert (status.values[Key.INLIERS], status.values[Key.TRACKED]) == ("80", "99")
    assert 0.0 <= float(status.values["capture_to_pose_max_ms"]) < 1e5


def test_a_camera_without_images_is_named(daemon: Daemon) -> None:
    daemon.shoot("lower")
    daemon.shoot("upper", age_s=TIMEOUT_S + 2)
    entries = daemon.collected()
    assert (entries["pairing"].level, entries["pairing"].message) == (WARN, "no images of the upper camera")
    assert (entries["upper camera"].level, entries["upper camera"].message) == (ERROR, "no new image")
    assert float(entries["upper camera"].values[Key.AGE_S]) == pytest.approx(TIMEOUT_S + 2, abs=0.2)
    assert entries["lower camera"].level == OK


def test_cameras_that_are_not_synchronised_are_named_and_a_pause_without_images_is_not(rig: Rig) -> None:
    daemon = Daemon(rig, PairConfig(tolerance_ms=1))
    daemon.collected()
    for number in range(10):
        daemon.shoot("lower", age_s=1.0 - 0.1 * number)
        daemon.shoot("upper", age_s=1.03 - 0.1 * number)
    assert "synchronise them" in daemon.collected()["pairing"].message
    assert daemon.collected()["pairing"].level == OK


def test_a_computer_that_is_too_slow_is_named_with_what_to_do(daemon: Daemon) -> None:
    daemon.collected()
    for dropped in (5, 20):
        daemon.shoot("lower", "upper")
        daemon.stages["pair"].processed += 100
        daemon.stages["pair"].dropped += dropped
        status = daemon.collected()["pairing"]
        assert ("too slow" in status.message and status.level == WARN) == (dropped > 10)


def test_the_status_reports_wheels_that_drive_are_stopped_or_faulty(daemon: Daemon) -> None:
    daemon.pose()
    daemon.tick()
    status = daemon.collected()["wheels"]
    assert (status.level, status.message) == (OK, "not armed since the start")
    assert status.values["armed"] == "0" and "omnid arm" in status.values["remedy"]
    daemon.commands.receive(Request("cmd/arm", codec.header_cdr(time.time_ns()), id=1))
    daemon.tick()
    status = daemon.collected()["wheels"]
    assert (status.level, status.message) == (OK, "no command")
    assert status.values["armed"] == "1" and not {"disarmed_by", "remedy", "source"} & set(status.values)
    assert "arm_refusal" not in status.values
    daemon.controller.take(TimedSetpoint(time.monotonic_ns(), Setpoint(0.2, None)))
    daemon.tick()
    status = daemon.collected()["wheels"]
    assert (status.level, status.message) == (OK, "driving") and status.values["sent"] == "3"
    assert status.values["source"] == "operator"
    assert "tick_late_p99_ms" in status.values
    daemon.pose("lost")
    daemon.tick()
    status = daemon.collected()["wheels"]
    assert (status.level, status.message) == (WARN, "the pose is lost")
    assert status.values["stopped, the pose is lost"] == "1"
    assert status.values["disarmed_by"] == "the pose is lost" and "source" not in status.values
    daemon.pose()
    daemon.tick()
    status = daemon.collected()["wheels"]
    assert (status.level, status.message) == (WARN, "not armed: the pose is lost")
    daemon.motor.fault = 7
    daemon.tick()
    status = daemon.collected()["wheels"]
    assert status.level == ERROR and status.values["fault"] == "7"


S = 1_000_000_000


def update(tiles: TileStates, stamp_ns: int) -> OdometryUpdate:
    """Return a pose whose pair has these tiles."""
    pair = small_depth(stamp_ns).panoramas
    return OdometryUpdate(
        0,
        stamp_ns,
        np.eye(4),
        np.eye(6),
        np.zeros(6),
        np.eye(6),
        TrackingState.TRACKING,
        0,
        9,
        9,
        StereoDepth(replace(pair, tiles=tiles)),
    )


def lost(first: int, last: int, *, is_dead: bool) -> TileStates:
    """Return tiles of which the upper camera has lost those columns."""
    none = np.zeros((TILE_ROWS, TILE_COLUMNS), bool)
    tiles = none.copy()
    tiles[:, np.arange(first, last) % TILE_COLUMNS] = True
    dead, blind = (tiles, none) if is_dead else (none, tiles)
    return TileStates(
        {"lower": none, "upper": dead},
        {"lower": none, "upper": blind},
        {"lower": none.any(axis=0), "upper": tiles.any(axis=0)},
    )


def test_the_status_names_the_camera() -> None:
    assert entry(IMAGES, image_stats(None)).level == STALE
    found = entry(IMAGES, image_stats(update(lost(23, 40, is_dead=False), 113 * S)))
    assert found.level == ERROR and found.values == {Key.REMEDY: REMEDIES[IMAGES]}
    assert found.message == "the upper camera is blind in a part of its view"
    frozen = entry(IMAGES, image_stats(update(lost(0, TILE_COLUMNS, is_dead=True), 114 * S)))
    assert frozen.message == "the upper camera is frozen all around"
    live = entry(IMAGES, image_stats(update(ALL_LIVE, 115 * S)))
    assert (live.level, live.message) == (OK, "")
