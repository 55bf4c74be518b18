"""A simulated robot in real time: cameras for `omnid run`, a motor controller on a pseudo-terminal, a gyro.

The daemon is the same as on a robot: it opens the terminal as its serial port, and takes the frames as those of two
cameras. Only the wheels decide what the cameras see next.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Final

import numpy as np

from drivers.cameras.camera_state import CameraState
from drivers.cameras.log_camera import LogClock
from drivers.frame import Camera, Frame
from drivers.motion import GyroSample
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.simulated.simulated_base import Pose
from drivers.motors.simulated.simulated_motor import SimulatedMotor, simulated_controller
from omnid.simulation.cameras import SimulatedCameras
from omnid.simulation.clearance import DriveRecord, clearance_m, footprints, obstacles_of
from omnid.simulation.lockstep import with_masks
from omnid.simulation.people import Walkers
from omnid.simulation.robot import SimulatedRobot, traction
from omnid.simulation.world import World

POLL_S: Final = 0.002  # Time between two checks whether the motion up to an exposure is known.
LONGEST_WAIT_S: Final = 0.2  # Longest wait for the motion up to an exposure; then the newest pose is taken.
SAMPLES: Final = 1  # per pixel and axis: textures are filtered, only edges of surfaces are not


class RealtimeRobot:
    """A robot whose time is that of the computer; `port` is its serial port."""

    def __init__(
        self,
        world: World,
        robot: SimulatedRobot,
        protocol: str,
        drive: DifferentialDrive,
        seed: int = 0,
        report: Callable[[str], None] | None = None,
    ) -> None:
        """Open the terminal. report: takes a line at each contact with an obstacle."""
        self.rig = with_masks(robot.rig)
        self._robot, self._world = robot, world
        controller = simulated_controller(protocol, drive)
        base = controller.base
        base.pose, base.limits, base.traction = world.start, robot.limits, traction(robot.wheels, seed)
        self._motor = SimulatedMotor(controller)
        self.port = self._motor.port
        self._gyro_noise = random.Random(seed + 1)
        self._turned = (0, base.pose[2])  # time [ns] and heading [rad] of the last measurement of the gyro
        self._yaw_rate_radps = 0.0
        self._rendered = SimulatedCameras(self.rig, robot.sensor, world, seed, SAMPLES)
        self._standing = obstacles_of(world, robot.height_m)
        self.drive = DriveRecord(report)  # with the stamps of the lower camera

    def open_camera(self, camera: Camera, clock: LogClock) -> SimulatedCamera:
        """Return a camera; clock: start of both cameras."""
        return SimulatedCamera(self, camera, clock, self._robot.rate_hz)

    def open_gyro(self) -> SimulatedGyro | None:
        """Return the gyro, None where the robot has none."""
        return SimulatedGyro(self.rates_radps, self._robot.gyro.rate_hz) if self._robot.has_gyro else None

    def close(self) -> None:
        """Close the terminal."""
        self._motor.close()

    def rates_radps(self) -> tuple[float, float, float]:
        """Return what the gyro measures about x, y, z [rad/s]: over the time since the pose before, as it was noted."""
        poses, errors = self._motor.poses, self._robot.gyro
        if poses:
            at_ns, (_, _, heading_rad) = poses[-1]
            before_ns, before_rad = self._turned
            if at_ns > before_ns:
                turned_rad = math.remainder(heading_rad - before_rad, math.tau) if before_ns else 0.0
                self._yaw_rate_radps = turned_rad / ((at_ns - before_ns) * 1e-9)
                self._turned = at_ns, heading_rad
        x, y, z = (bias + errors.noise_radps * self._gyro_noise.gauss(0.0, 1.0) for bias in errors.bias_radps)
        return x, y, z + self._yaw_rate_radps

    def pose_at(self, stamp_ns: int) -> Pose:
        """Return the pose at a time, as soon as it is known."""
        until_s = time.monotonic() + LONGEST_WAIT_S
        poses = self._motor.poses
        while (not poses or poses[-1][0] < stamp_ns) and time.monotonic() < until_s:
            time.sleep(POLL_S)
        recent: list[tuple[int, Pose]] = []
        while not recent:
            with suppress(RuntimeError):  # the base moved meanwhile
                recent = list(poses)
        times = np.array([ns for ns, _ in recent], np.int64) - stamp_ns
        places = np.array([pose for _, pose in recent])
        places[:, 2] = np.unwrap(places[:, 2])
        x_m, y_m, heading_rad = (float(np.interp(0, times, column)) for column in places.T)
        return x_m, y_m, math.remainder(heading_rad, math.tau)

    def frame(self, camera: Camera, seq: int, stamp_ns: int, people: Walkers, time_s: float) -> Frame:
        """Return the frame of a camera at a time."""
        pose = self.pose_at(stamp_ns)
        people.advance(time_s, pose[:2])
        if camera == "lower":
            walking = footprints(people.faces(), self._robot.height_m)
            clearances_m = [clearance_m(one, pose[:2], self._robot.radius_m) for one in (self._standing, walking)]
            self.drive.add_pose(stamp_ns, pose)
            self.drive.add_clearance(min(clearances_m), pose)
        T_world_rig = self._world.ground.T_world_base(pose) @ self._robot.T_base_leaning @ self.rig.T_base_rig
        return self._rendered.frame(camera, seq, stamp_ns, T_world_rig, people)

    def walkers(self) -> Walkers:
        """Return the people at the start; each camera has its own copies, which walk in the same way."""
        return Walkers(self._world.people)


class SimulatedGyro:
    """The gyro of a RealtimeRobot: measures at a rate in real time; late measurements are left out."""

    def __init__(self, rates_radps: Callable[[], tuple[float, float, float]], rate_hz: float) -> None:
        """rates_radps: called for each measurement."""
        self._rates, self._period_s = rates_radps, 1.0 / rate_hz
        self._closed = False

    def samples(self) -> Iterator[GyroSample]:
        """Yield the measurements, stamped by CLOCK_MONOTONIC, until closed."""
        due_s = time.monotonic()
        while not self._closed:
            time.sleep(max(0.0, due_s - time.monotonic()))
            yield GyroSample(time.monotonic_ns(), *self._rates())
            due_s = max(due_s + self._period_s, time.monotonic())

    def close(self) -> None:
        """End samples(); may be called twice, from any thread."""
        self._closed = True


class SimulatedCamera:
    """One camera of a RealtimeRobot; a frame that cannot be rendered in time is dropped and counted."""

    def __init__(self, robot: RealtimeRobot, camera: Camera, clock: LogClock, rate_hz: float) -> None:
        self._robot, self._camera, self._clock = robot, camera, clock
        self._period_ns = round(1e9 / rate_hz)
        self._closed = False
        self.state = CameraState(mode="simulated")

    def frames(self) -> Iterator[Frame]:
        """Yield the frames when they were exposed, until closed."""
        start_ns, seq, people = self._clock.epoch_ns(), 0, self._robot.walkers()
        while not self._closed:
            stamp_ns = start_ns + seq * self._period_ns
            self._sleep_until(stamp_ns)
            late = max(0, time.monotonic_ns() - stamp_ns) // self._period_ns
            if late:
                self.state.drops += late
                seq += late
                continue
            if not self._closed:
                self.state.status = "streaming"
                self.state.frames += 1
                yield self._robot.frame(self._camera, seq, stamp_ns, people, seq * self._period_ns * 1e-9)
            seq += 1
        self.state.status = "closed"

    def close(self) -> None:
        """End frames(); may be called twice, from any thread."""
        self._closed = True

    def _sleep_until(self, due_ns: int) -> None:
        while not self._closed and (left_s := (due_ns - time.monotonic_ns()) * 1e-9) > 0:
            time.sleep(min(left_s, 0.02))
