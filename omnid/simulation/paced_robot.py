"""A simulated robot in place of the cameras and the motor of a live run.

Its time waits for the daemon, and does not run faster than the computer's. Deadlines, ramps and watchdogs are judged by
this one clock. The daemon's messages reach the controller at its ticks, and are dated by this clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from queue import SimpleQueue
from typing import Any

from drivers.cameras.camera_state import CameraState
from drivers.frame import CAMERAS, Camera, Frame
from drivers.motion import MotionSample
from drivers.motor import VelocityCommand
from drivers.motors.simulated_motor import Pose
from omnid.config import Config
from omnid.controller.ipc import TickReport
from omnid.controller.link import ControllerStatistics, DriveLink
from omnid.core.control.arming import NO_CONTACT, ArmRequest, TimedSetpoint
from omnid.core.control.control_law import ControlInput
from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.engine.graph import StageStats, Stream, no_op, sleep_until
from omnid.engine.robot_clock import fixed_offset
from omnid.runs.wiring import Session
from omnid.simulation.robot import SimulatedRobot, Tick, Vehicle
from omnid.simulation.world import World
from omnid.transport.status_names import SIMULATION, Key


class PacedRobot:
    """A LiveRobot in simulated time, and the DriveLink to its controller: see `Vehicle.post` for what arrives when."""

    waits = True
    brings_samples = True

    def __init__(self, world: World, robot: SimulatedRobot, config: Config, seed: int) -> None:
        """Set the robot up, with the controller of the settings."""
        self.rig = robot.rig
        self._start_ns = self._first_ns = time.monotonic_ns()  # of the computer when the first pair was given, too
        self._report: Callable[[str], None] = no_op
        self._vehicle = Vehicle(
            world,
            replace(robot, samples=1),
            config,
            seed,
            self._take_tick,
            lambda _, line: self._report(line),
            self._start_ns,
        )
        # The simulated time begins with that of the computer, and never runs ahead of it.
        self.clock = fixed_offset(lambda: self._vehicle.now_ns)
        self._ticks = StageStats()
        self.statistics = ControllerStatistics(self._ticks)
        self._commands: SimpleQueue[VelocityCommand | None] = SimpleQueue()  # None: the end
        self._contact = NO_CONTACT
        self.states: Mapping[Camera, CameraState] = {
            camera: CameraState(mode="simulated", status="streaming") for camera in CAMERAS
        }
        self.truth: dict[int, Pose] = {}  # true poses of the base in the world by the stamps of the pairs
        self.contacts, self._touches, self._closed = 0, False, False

    def connect(self, session: Session) -> tuple[list[Stream[Frame | MotionSample]], DriveLink]:
        """Return one source of both cameras, which advances the time, and the link to the controller."""
        graph, self._report = session.graph, session.warn
        graph.stats["motor"] = self._ticks
        session.parts[SIMULATION] = self.stats
        return [graph.source("cameras", lambda: self._messages(graph.settle), wake=self.close)], self

    def stats(self) -> dict[str, Any]:
        """Return the real-time factor, the time since the start [s] and the contacts with obstacles."""
        passed_ns = self._vehicle.now_ns - self._start_ns
        factor = round(passed_ns / max(1, time.monotonic_ns() - self._first_ns), 2)
        return {Key.REAL_TIME_FACTOR: factor, "time_s": passed_ns * S_PER_NS, "contacts": self.contacts}

    def close(self) -> None:
        """End the images; from any thread."""
        self._closed = True

    def send(self, given: ControlInput) -> None:
        """Send a pose, an obstacle scan, a setpoint, or a request to arm."""
        self._vehicle.post(given._replace(arrival_ns=0) if isinstance(given, TimedSetpoint | ArmRequest) else given)

    def stop(self) -> None:
        """Stop the wheels until a request to arm is sent later."""
        self._vehicle.post("stop")

    def touch(self, contact: str, *, holds: bool) -> None:
        """Report a bumper or a cliff sensor; from one thread."""
        self._contact = self._contact.after(contact, holds=holds)
        self._vehicle.post(self._contact)

    def end(self) -> None:
        """Let `commands` end after the last one; the simulation makes sure that the wheels are at rest."""
        self._commands.put(None)

    def commands(self) -> Iterator[VelocityCommand]:
        """Yield the commands of the ticks until the end."""
        while (command := self._commands.get()) is not None:
            yield command

    def _messages(self, settle: Callable[[], None]) -> Iterator[Frame | MotionSample]:
        """Advance from pair to pair; settle: returns when the daemon has answered."""
        vehicle, due_ns, period_ns = self._vehicle, 0, round(NS_PER_S / self._vehicle.robot.rate_hz)
        try:
            for pair in vehicle.pairs(settle):
                self.truth[pair.stamp_ns] = vehicle.base.pose
                yield from pair.samples
                # Images are not given before their time; a pair that comes late is not made up for.
                sleep_until(due_ns, lambda: self._closed)
                if self._closed:
                    return
                now_ns = time.monotonic_ns()
                self._first_ns = self._first_ns if due_ns else now_ns
                due_ns = max(due_ns + period_ns, now_ns)
                for frame in pair.frames:
                    self.states[frame.camera].frames += 1
                    yield frame
        finally:
            self._report = no_op  # That no more poses come then needs no line.
            vehicle.come_to_rest()
            self.end()

    def _take_tick(self, tick: Tick, report: TickReport) -> None:
        """Pass a tick on; count and report a contact when it begins."""
        self.statistics.add(report)
        if report.command is not None:
            self._commands.put(report.command)
        touches = tick.clearance_m <= 0
        if touches and not self._touches:
            self.contacts += 1
            self._report(f"contact with an obstacle at {tick.pose[0]:.2f}, {tick.pose[1]:.2f} m in the world")
        self._touches = touches
