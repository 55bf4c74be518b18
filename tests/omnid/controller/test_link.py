"""The controller process, seen from the daemon: a real one, with a simulated motor behind a real pty."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers.motor import VelocityCommand
from omnid.controller.controller import Controller
from omnid.controller.ipc import Channel, ControllerStart, ControllerUpdate, TickReport, socket_pair
from omnid.controller.link import ControllerLink
from omnid.controller.motor import MotorSettings
from omnid.controller.process import run_controller, run_until_end
from omnid.core.control import safety_rules
from omnid.core.control.arming import AUTOMATIC, MANUAL, ArmRequest, TimedSetpoint
from omnid.core.control.collision_monitor import BLOCKED, SCAN_STALE, CollisionSettings, ControllerScan, remedy
from omnid.core.control.control_law import ControllerPose, ControllerSettings, ControllerState
from omnid.core.control.heading_controller import Setpoint, VelocityLimits
from omnid.core.control.safety_rules import BUMPER, CLIFF, Deadlines
from omnid.engine.graph import StageStats
from omnid.engine.process import RealtimeSettings
from omnid.errors import OmnidError
from tests.contract.simulated_controllers import PtyMotor
from tests.omnid.controller.bench import PERIOD_S, UNATTENDED, Wheels
from tests.replay.live import Base
from tests.waiting import ROOT, wait_until

HEAVY = (
    "calib.models",
    "calib.panorama",
    "calib.rig",
    "calib.se3",
    "cv2",
    "numpy",
    "rosbags",
    "scipy",
    "zenoh",
    "drivers.cameras",
    "drivers.frame",
    "drivers.logs",
    "drivers.motors.simulated_motor",
    "omnid.config",
    "omnid.core.mapping",
    "omnid.core.odometry",
    "omnid.core.places",
    "omnid.core.stereo",
    "omnid.engine.graph",
    "omnid.messages",
    "omnid.stages",
    "omnid.transport",
)


def loaded(statement: str) -> list[str]:
    """Return the names of the modules that a fresh interpreter has loaded after a statement."""
    script = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    names: list[str] = json.loads(done.stdout)
    return names


def test_the_controller_loads_no_module_of_perception() -> None:
    modules = loaded("import omnid.controller.process")
    assert "omnid.controller.controller" in modules
    assert [name for name in modules if any(f"{name}.".startswith(f"{heavy}.") for heavy in HEAVY)] == []


pytestmark = pytest.mark.usefixtures("default_signals")

DEADLINES = Deadlines(pose_s=5.0, command_s=5.0, tick_s=5.0)  # a busy machine is late with everything
AHEAD = Setpoint(0.4, None, 0.0)
DECELERATION_MPS2 = 0.8


def start_message(port: object, arming: str = AUTOMATIC, *, has_scans: bool = False) -> ControllerStart:
    limits = VelocityLimits(deceleration_mps2=DECELERATION_MPS2)
    motor = MotorSettings(port=str(port), rate_hz=10.0, watchdog_ms=5000)
    settings = ControllerSettings(DEADLINES, limits, arming=arming, collision=CollisionSettings(stale_s=2.0))
    settings = settings if has_scans else settings.without_obstacles
    return ControllerStart(motor, settings, RealtimeSettings())


def pose(heading_rad: float = 0.0, rate_radps: float = 0.0) -> ControllerPose:
    return ControllerPose(time.monotonic_ns(), heading_rad, rate_radps, "tracking")


class Robot:
    """A link, and a thread that reads the commands to the wheels."""

    def __init__(self, base: Base, arming: str = AUTOMATIC, *, has_scans: bool = False) -> None:
        self.base = base
        self.commands: list[VelocityCommand] = []
        self.lines: list[str] = []
        self.error: OmnidError | None = None
        self.stats = StageStats()
        start = start_message(base.port, arming, has_scans=has_scans)
        self.link = ControllerLink(start, self.stats, self.lines.append)
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    @property
    def pid(self) -> int:
        return self.link._process.pid

    def drive(self) -> None:
        """Send poses and setpoints until it moves: on a busy machine an answer may be late, which stops it."""
        wait_until(lambda: self._sent() and self.base.line.base.velocity_mps > 0.38, "motion")

    def _sent(self) -> bool:
        self.link.send(pose())
        self.link.send(TimedSetpoint(time.monotonic_ns(), AHEAD))
        return True

    def has_pose(self) -> bool:
        """Send a pose; True."""
        self.link.send(pose())
        return True

    def drives(self, velocity_mps: float, ranges: tuple[float, ...] | None) -> bool:
        """Send a command, and a scan unless there is none; True once the wheels turn in that direction."""
        self.link.send(pose())
        if ranges is not None:
            self.link.send(ControllerScan(time.monotonic_ns(), ranges))
        self.link.send(TimedSetpoint(time.monotonic_ns(), Setpoint(velocity_mps)))
        return self.base.line.base.velocity_mps * velocity_mps > 0.01

    def stands(self, velocity_mps: float, ranges: tuple[float, ...] | None) -> bool:
        """Send the same; True once the wheels stand."""
        self.drives(velocity_mps, ranges)
        return self.base.line.base.velocity_mps == 0.0

    def joined(self) -> None:
        self._thread.join(20)
        assert not self._thread.is_alive()

    def _read(self) -> None:
        try:
            self.commands.extend(self.link.commands())
        except OmnidError as error:
            self.error = error


@contextlib.contextmanager
def started(folder: Path, arming: str = AUTOMATIC, *, has_scans: bool = False) -> Iterator[Robot]:
    with contextlib.closing(Base(folder)) as base:
        robot = Robot(base, arming, has_scans=has_scans)
        try:
            yield robot
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(robot.pid, signal.SIGCONT)
            robot.link.end()
            robot.joined()
            robot.link.close()


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with started(tmp_path) as robot:
        yield robot


def slowed_down(base: Base) -> None:
    """Expect commands of ever lower speeds, not a stop at once."""
    speeds = [note.wheels_mps[0] for note in base.line.notes]
    top = max(index for index, speed in enumerate(speeds) if speed == max(speeds))
    ramp = speeds[top:]
    assert ramp[-1] == 0.0 and len(set(ramp)) > 3 and all(a >= b for a, b in pairwise(ramp)), ramp


def test_poses_and_setpoints_turn_the_wheels_and_each_tick_is_counted(robot: Robot) -> None:
    robot.drive()
    statistics = robot.link.statistics
    wait_until(lambda: statistics.state.sent > 5, "a report")
    assert robot.stats.processed > 5 and robot.stats.busy_since_ns > 0
    robot.link.stop()
    wait_until(lambda: not robot.base.drives, "the stop")
    wait_until(lambda: statistics.state.stops[safety_rules.ASKED] == 1, "its count")
    assert any(line.startswith("the wheels stop: a stop was asked for; ") for line in robot.lines)
    robot.link.end()
    robot.joined()
    assert robot.commands[-1].velocity_mps == 0.0 and max(command.velocity_mps for command in robot.commands) > 0.38
    assert robot.error is None and robot.stats.busy_since_ns == 0


@pytest.mark.hazard("H39")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGABRT])
def test_the_controller_survives_signals_that_end_the_daemon(robot: Robot, number: int) -> None:
    robot.drive()
    os.kill(robot.pid, number)
    count = robot.link.statistics.state.sent
    wait_until(lambda: robot.link.statistics.state.sent > count + 5, "more ticks")


def test_a_killed_process_raises_an_error(robot: Robot) -> None:
    robot.drive()
    os.kill(robot.pid, signal.SIGKILL)
    robot.joined()
    assert robot.error is not None and "exit code -9" in str(robot.error) and "\n" not in str(robot.error)
    robot.link.stop()  # from threads that do not know it yet
    robot.link.send(pose())


@pytest.mark.hazard("H03")
def test_a_stop_rides_along_with_everything_that_follows_and_needs_a_later_request(tmp_path: Path) -> None:
    """The process misses the stop itself, then receives a request that is older and one that is younger than it."""
    with started(tmp_path, MANUAL) as robot:
        state = robot.link.statistics
        wait_until(lambda: robot.has_pose() and state.state.reason == safety_rules.NOT_ARMED, "a pose that counts")
        arm(robot)
        wait_until(lambda: state.state.armed, "the arming")
        robot.drive()
        early = ArmRequest(time.monotonic_ns(), 1)
        send, robot.link._channel.send = robot.link._channel.send, lambda _: None  # type: ignore[method-assign]
        robot.link.stop()
        robot.link._channel.send = send  # type: ignore[method-assign]
        robot.link.send(early)
        wait_until(lambda: not robot.base.drives, "the stop")
        wait_until(lambda: state.state.arm_answer.id == 1, "the answer")
        assert not state.state.armed and state.state.disarmed_by == safety_rules.ASKED
        arm(robot)
        wait_until(lambda: state.state.armed, "the release")
        robot.drive()


@pytest.mark.hazard("H08")
def test_a_contact_that_has_ended_and_whose_messages_were_lost_still_stops_the_base(robot: Robot) -> None:
    """The count of contacts rides along with everything that follows, and latches without an operator, too."""
    robot.drive()
    send, robot.link._channel.send = robot.link._channel.send, lambda _: None  # type: ignore[method-assign]
    robot.link.touch(BUMPER, holds=True)
    robot.link.touch(BUMPER, holds=False)
    robot.link._channel.send = send  # type: ignore[method-assign]
    robot.link.send(pose())
    state = robot.link.statistics
    wait_until(lambda: state.state.disarmed_by == BUMPER and not robot.base.drives, "the stop")
    robot.link.touch(CLIFF, holds=True)
    arm(robot)
    wait_until(lambda: state.state.arm_answer.refusal == CLIFF, "the refusal while it holds")
    robot.link.touch(CLIFF, holds=False)
    wait_until(lambda: arm(robot) or state.state.armed, "the release")  # type: ignore[func-returns-value]
    robot.drive()


def arm(robot: Robot) -> None:
    robot.link.send(ArmRequest(time.monotonic_ns(), 2))


OWNER = """
import sys, time
from tests.omnid.controller.test_link import AHEAD, ControllerLink, StageStats, TimedSetpoint, pose, start_message
link = ControllerLink(start_message(sys.argv[1]), StageStats(), print)
while True:
    link.send(pose())
    link.send(TimedSetpoint(time.monotonic_ns(), AHEAD))
    time.sleep(0.05)
"""


@pytest.mark.hazard("H39")
def test_the_base_slows_down_when_the_daemon_is_killed(tmp_path: Path) -> None:
    with contextlib.closing(Base(tmp_path)) as base:
        command = [sys.executable, "-c", OWNER, str(base.port)]
        with subprocess.Popen(command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}) as owner:
            wait_until(lambda: base.line.base.velocity_mps > 0.38 or owner.poll() is not None, "motion")
            owner.kill()
        wait_until(lambda: not base.drives and base.line.notes[-1].wheels_mps == (0.0, 0.0), "the stop")
        slowed_down(base)
        assert not base.twin.base.watchdog_expired, "the process stopped it, not the watchdog"
        wait_until(lambda: not _has_open(base), "the end of the process")


def _has_open(base: Base) -> bool:
    """True if another process has the port open."""
    port = base.port.resolve()
    for folder in Path("/proc").glob("[0-9]*/fd"):
        if folder.parent.name != str(os.getpid()):
            with contextlib.suppress(OSError):
                if any(os.readlink(entry) == str(port) for entry in folder.iterdir()):
                    return True
    return False


@pytest.mark.hazard("H04")
def test_a_motor_controller_that_comes_late_or_again_drives_only_after_it_was_armed(tmp_path: Path) -> None:
    port, lines = tmp_path / "motor", list[str]()
    start = start_message(port, MANUAL)
    motor = replace(start.motor, boot_s=1.0, watchdog_ms=500)
    link = ControllerLink(start._replace(motor=motor), StageStats(), lines.append)
    with ThreadPoolExecutor() as threads, contextlib.closing(link):
        reading = threads.submit(list, link.commands())

        def state(*, arm: bool = True) -> ControllerState:
            link.send(pose())
            if arm and not link.statistics.state.armed:
                link.send(ArmRequest(time.monotonic_ns(), 1))
            link.send(TimedSetpoint(time.monotonic_ns(), AHEAD))
            return link.statistics.state

        # 1. There is no port: it is waited for, and nothing can be armed.
        wait_until(lambda: "no such port" in state().problem and bool(state().arm_answer.id), "the wait for the port")
        assert state().reason == state().arm_answer.refusal == safety_rules.AWAITED and not state().armed
        for _ in range(2):
            with contextlib.closing(PtyMotor()) as board:
                port.symlink_to(board.port)
                # 2. It is plugged in: it answers, and stands.
                sent = state(arm=False).sent
                wait_until(lambda sent=sent: state(arm=False).sent > sent + 5, "its answers")  # type: ignore[misc]
                assert not state(arm=False).armed and board.base.commanded_mps == [0.0, 0.0]
                # 3. It drives after it was armed.
                wait_until(lambda board=board: state().armed and board.base.velocity_mps > 0.2, "motion")  # type: ignore[misc]
                port.unlink()
            wait_until(lambda: state().failed and not state().armed, "the fault")
        link.end()
        reading.result()
    assert "the motor controller answers" in lines and "the motor controller is back" in lines


FREE = (math.inf,) * 360
WALL = tuple(0.38 if 150 <= k < 210 else math.inf for k in range(360))  # ahead, in the stop polygon


@pytest.mark.hazard("H16", "H21")
def test_the_wheels_stop_before_an_obstacle_and_when_no_more_scans_come(tmp_path: Path) -> None:
    with started(tmp_path, has_scans=True) as robot:
        state = robot.link.statistics
        wait_until(lambda: robot.drives(0.3, FREE), "motion")
        wait_until(lambda: robot.stands(0.3, WALL), "the stop")
        assert state.state.blocked and state.state.obstacle == BLOCKED and state.state.armed
        assert any(line == f"the wheels stop: {BLOCKED}; {remedy(BLOCKED)}" for line in robot.lines)
        wait_until(lambda: robot.drives(-0.3, WALL), "the way back")
        wait_until(lambda: robot.drives(0.3, FREE), "motion where the way is free")
        wait_until(lambda: robot.stands(0.3, None), "the stop")
        assert state.state.obstacle == SCAN_STALE
        wait_until(lambda: robot.drives(0.3, FREE), "motion again, without arming")


# The loop of the controller process: what it receives before a tick, that no flood keeps the tick, and its end.
PATIENCE_S = 30.0


class Flooded(Channel):
    """A channel that is never empty until its end: the daemon sends faster than any process could receive."""

    def __init__(self, end: socket.socket) -> None:
        super().__init__(end)
        self.ended = False

    def receive(self, timeout_s: float) -> ControllerUpdate:
        """Return a message at once."""
        if self.ended:
            raise EOFError
        return ControllerUpdate(0, pose())


def test_a_flood_of_messages_does_not_keep_a_tick() -> None:
    ours, theirs = socket_pair()
    wheels = Wheels()
    with ours, theirs:
        channel = Flooded(theirs)
        controller = Controller(wheels, UNATTENDED, PERIOD_S)
        thread = threading.Thread(target=run_until_end, args=(channel, controller), daemon=True)
        thread.start()
        deadline_s = time.monotonic() + PATIENCE_S
        while len(wheels.commands) < 5:
            assert time.monotonic() < deadline_s, "no ticks beside a flood"
            time.sleep(0.01)
        channel.ended = True
        thread.join(PATIENCE_S)


def test_ticks_keep_the_rhythm_of_the_settings() -> None:
    """The times at which ticks were due are multiples of the period, however late each was."""
    ours, theirs = socket_pair()
    daemon, period_s = Channel(ours), 0.04
    with contextlib.closing(PtyMotor()) as motor, ours:
        settings = MotorSettings(port=motor.port, rate_hz=1 / period_s, watchdog_ms=5000)
        daemon.send(ControllerStart(settings, UNATTENDED, RealtimeSettings(motor_priority=0)))
        thread = threading.Thread(target=run_controller, args=(Channel(theirs),))
        thread.start()
        due_s: list[float] = []
        while len(due_s) < 12:
            report = daemon.receive(PATIENCE_S)
            if isinstance(report, TickReport) and report.command is not None:
                due_s.append(report.command.stamp_ns * 1e-9 - report.late_s)
        daemon.finish_sending()
        thread.join(PATIENCE_S)
    periods = np.diff(due_s) / period_s
    assert np.abs(periods - periods.round()).max() < 0.01 and periods.round().min() == 1
