"""A simulated robot in place of the cameras and the motor of a live run.

Its time waits for the daemon, and does not run faster than the computer's. Deadlines, ramps and watchdogs are judged by
this one clock. The daemon's messages reach the controller at its ticks, and are dated by this clock.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from queue import SimpleQueue
from typing import Any, Final

from drivers.cameras.camera_state import CameraState
from drivers.frame import CAMERAS, Frame
from drivers.motion import GyroSample, MotionSample
from drivers.motor import VelocityCommand
from drivers.motors.simulated_motor import Pose
from omnid.config import Config
from omnid.controller.link import ControllerStatistics, DriveLink
from omnid.controller.statistics import TickReport
from omnid.core.control.arming import ArmRequest
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.contacts import NO_CONTACT
from omnid.core.control.control_law import ControlInput
from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.engine.graph import Stream
from omnid.engine.telemetry import StageStats
from omnid.engine.threads import sleep_until
from omnid.runs.session import Session
from omnid.simulation.robot import SimulatedRobot, with_masks
from omnid.simulation.vehicle import Tick, Vehicle
from omnid.simulation.world import World
from omnid.transport.status_names import Key


class PacedLink:
    """A DriveLink whose controller is stepped by a simulation: see `Vehicle.post` for when it is given something."""

    def __init__(self, vehicle: Vehicle, stats: StageStats) -> None:
        """stats: counters of the tick."""
        self.statistics = ControllerStatistics(stats)
        self._vehicle = vehicle
        self._commands: SimpleQueue[VelocityCommand | None] = SimpleQueue()  # None: the end
        self._contacts = NO_CONTACT

    def send(self, given: ControlInput) -> None:
        """Send a pose, an obstacle scan, a setpoint, or a request to arm."""
        if isinstance(given, TimedSetpoint | ArmRequest):
            given = given._replace(arrival_ns=0)
        self._vehicle.post(given)

    def stop(self) -> None:
        """Stop the wheels until a request to arm is sent later."""
        self._vehicle.post("stop")

    def touch(self, contact: str, *, holds: bool) -> None:
        """Report a bumper or a cliff sensor; from one thread."""
        self._contacts = self._contacts.after(contact, holds=holds)
        self._vehicle.post(self._contacts)

    def end(self) -> None:
        """Let `commands` end after the last one; the simulation makes sure that the wheels are at rest."""
        self._commands.put(None)

    def commands(self) -> Iterator[VelocityCommand]:
        """Yield the commands of the ticks until the end."""
        while (command := self._commands.get()) is not None:
            yield command

    def take(self, report: TickReport) -> None:
        """Take the report of a tick."""
        self.statistics.add(report._replace(state=copy.deepcopy(report.state)))  # the controller changes its own
        if report.command is not None:
            self._commands.put(report.command)


class PacedRobot:
    """A LiveRobot in simulated time."""

    waits: Final = True
    brings_samples: Final = True

    def __init__(
        self,
        world: World,
        robot: SimulatedRobot,
        config: Config,
        seed: int,
        report: Callable[[str], None],
        *,
        keeps_truth: bool = False,
    ) -> None:
        """report: takes a line at each contact with an obstacle. keeps_truth: the true poses, 250 bytes a pair."""
        self._report, self._keeps_truth = report, keeps_truth
        self.rig = with_masks(robot.rig)
        self._world, self._robot, self._config, self._seed = world, replace(robot, samples=1), config, seed
        self._start_ns = time.monotonic_ns()
        self._vehicle: Vehicle | None = None
        self._link: PacedLink | None = None
        self.states = {camera: CameraState(mode="simulated", status="streaming") for camera in CAMERAS}
        self._given_ns = [0, 0]  # when the first pair and the newest one were given, by the computer's clock
        self._given = 0  # pairs
        self._closed = self._ends = False
        self.truth: dict[int, Pose] = {}  # true poses of the base in the world by the stamps of the pairs, where kept
        self.contacts, self._touches = 0, False

    def clock_ns(self) -> int:
        """Return the simulated time; it begins with that of the computer, and never runs ahead of it."""
        return self._start_ns if self._vehicle is None else self._vehicle.now_ns

    def connect(self, session: Session, take: Callable[[MotionSample], None]) -> tuple[list[Stream[Frame]], DriveLink]:
        """Set the robot up, with the controller of the settings; one source of both cameras advances the time."""
        config = replace(session.config, controller=session.with_obstacles_known(session.config.controller))
        stats = session.graph.telemetry.add(StageStats("motor", is_ticker=True))

        def warn(_: float, line: str) -> None:
            if not self._ends:  # no more poses come then, which needs no line
                session.warn(line)

        self._vehicle = Vehicle(self._world, self._robot, config, self._seed, self._take_tick, warn, self._start_ns)
        self._link = PacedLink(self._vehicle, stats)
        graph = session.graph
        return [graph.source("cameras", lambda: self._frames(graph.settle, take), wake=self.close)], self._link

    def stats(self) -> dict[str, Any]:
        """Return the real-time factor, the time since the start [s] and the contacts with obstacles."""
        time_s, passed_ns = (self.clock_ns() - self._start_ns) * S_PER_NS, self._given_ns[1] - self._given_ns[0]
        simulated_ns = (self._given - 1) * NS_PER_S / self._robot.rate_hz
        factor = round(simulated_ns / passed_ns, 2) if passed_ns else math.nan
        words = "its time waits for the daemon"
        return {Key.REAL_TIME_FACTOR: factor, "time_s": time_s, "contacts": self.contacts, "_words": words}

    def close(self) -> None:
        """End the images; from any thread."""
        self._closed = True

    def _frames(self, settle: Callable[[], None], take: Callable[[MotionSample], None]) -> Iterator[Frame]:
        """Advance from pair to pair; settle: returns when the daemon has answered."""
        vehicle, link, motion = self._vehicle, self._link, self._config.motion
        assert vehicle is not None and link is not None
        due_ns, period_ns = 0, round(NS_PER_S / self._robot.rate_hz)
        try:
            for pair in vehicle.pairs(settle):
                if self._keeps_truth:
                    self.truth[pair.stamp_ns] = vehicle.base.pose
                for sample in pair.samples:
                    if (motion.imu if isinstance(sample, GyroSample) else motion.wheels) != "off":
                        take(sample)
                # Images are not given before their time; a pair that comes late is not made up for.
                sleep_until(due_ns, lambda: self._closed)
                if self._closed:
                    return
                self._given, now_ns = self._given + 1, time.monotonic_ns()
                self._given_ns = [self._given_ns[0] or now_ns, now_ns]
                due_ns = max(due_ns + period_ns, now_ns)
                for frame in pair.frames:
                    self.states[frame.camera].frames += 1
                    yield frame
        finally:
            self._ends = True
            vehicle.come_to_rest()
            link.end()

    def _take_tick(self, tick: Tick, report: TickReport) -> None:
        """Pass a tick on; count and report a contact when it begins."""
        assert self._link is not None
        self._link.take(report)
        touches = tick.clearance_m <= 0
        if touches and not self._touches:
            self.contacts += 1
            self._report(f"contact with an obstacle at {tick.pose[0]:.2f}, {tick.pose[1]:.2f} m in the world")
        self._touches = touches
