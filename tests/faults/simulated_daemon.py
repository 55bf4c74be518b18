"""`omnid simulate` whose wheels are simulated in another process, which outlives the daemon; faults of the cameras.

The other process writes the poses of the base into a file (`PoseFile`). Lines on the standard input, as in
tests.replay.faulty: "upper mute" or "both mute": no more images; "both ok": no fault.
"""

from __future__ import annotations

import argparse
import mmap
import struct
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from drivers.cameras.log_camera import LogClock
from drivers.frame import Camera, Frame
from drivers.motors.simulated.simulated_base import Pose
from drivers.motors.simulated.simulated_motor import SimulatedMotor
from omnid.config import load_config
from omnid.runs.live import LiveRun
from omnid.runs.live_robot import ConnectedRobot
from omnid.simulation.realtime import RealtimeRobot, SimulatedCamera
from omnid.simulation.robot import make_robot
from omnid.simulation.world_file import load_world
from tests.replay.faulty import read_faults

SIZE_PX: Final = 256
WORLD: Final = "room"
SEED: Final = 1
RATE_HZ: Final = 6.0  # beside other programs on two cores
SLOTS: Final = 256
SLOT: Final = struct.Struct("<q3d")  # time (CLOCK_MONOTONIC) [ns], x, y [m], heading [rad]
PERIOD_S: Final = 0.005


class PoseFile:
    """The newest poses of a base, in a file that two processes share."""

    port = ""  # set by the daemon

    def __init__(self, path: Path) -> None:
        """Open the file; it is made if it is missing."""
        if not path.exists():
            path.write_bytes(bytes(SLOTS * SLOT.size))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), SLOTS * SLOT.size)
        self._next = 0

    def write(self, at_ns: int, pose: Pose) -> None:
        """Add a pose, in the place of the oldest one."""
        SLOT.pack_into(self._memory, (self._next % SLOTS) * SLOT.size, at_ns, *pose)
        self._next += 1

    @property
    def poses(self) -> list[tuple[int, Pose]]:
        """The poses in their order; the oldest ones, which may be replaced meanwhile, are left out."""
        found = sorted(slot for slot in SLOT.iter_unpack(bytes(self._memory)) if slot[0])
        return [(slot[0], (slot[1], slot[2], slot[3])) for slot in found[4:] or found]

    def close(self) -> None:
        """Do nothing: the pages stay until both processes have ended."""


class PoseWriter:
    """Writes the poses of a simulated motor into a file until it is closed."""

    def __init__(self, motor: SimulatedMotor, file: PoseFile) -> None:
        self._motor, self._file = motor, file
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._write, name="poses")
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        self._thread.join()

    def _write(self) -> None:
        while not self._closing.wait(PERIOD_S):
            self._file.write(time.monotonic_ns(), self._motor.pose)


class RemoteRobot(RealtimeRobot):
    """A robot whose wheels turn in another process."""

    def __init__(self, poses: PoseFile, port: str, faults: dict[str, str]) -> None:
        drive = load_config().motor.drive.geometry()
        super().__init__(load_world(WORLD, SEED), make_robot(SIZE_PX), "line", drive, SEED)
        self._motor.close()
        self._motor, self.port, self.faults = poses, port, faults  # type: ignore[assignment]

    def open_camera(self, camera: Camera, clock: LogClock) -> SimulatedCamera:
        """Return a camera that may lose its images."""
        return MutedCamera(self, camera, clock, self.faults)


class MutedCamera(SimulatedCamera):
    """A simulated camera that gives no images while its fault is "mute"."""

    def __init__(self, robot: RemoteRobot, camera: Camera, clock: LogClock, faults: dict[str, str]) -> None:
        super().__init__(robot, camera, clock, RATE_HZ)
        self._name, self._faults = camera, faults

    def frames(self) -> Iterator[Frame]:
        """Yield the frames, those without a fault."""
        return (frame for frame in super().frames() if self._faults.get(self._name) != "mute")


def main() -> int:
    """Run the daemon and return its exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--motor", required=True)
    parser.add_argument("--poses", type=Path, required=True)
    parser.add_argument("--set", action="append", dest="settings", default=[])
    args = parser.parse_args()
    faults: dict[str, str] = {}
    threading.Thread(target=read_faults, args=(faults,), daemon=True).start()
    robot, clocks = RemoteRobot(PoseFile(args.poses), args.motor, faults), [LogClock() for _ in range(2)]
    opened: dict[Camera, int] = {}

    def open_camera(camera: Camera):  # type: ignore[no-untyped-def]
        opened[camera] = opened.get(camera, -1) + 1
        return robot.open_camera(camera, clocks[opened[camera]])

    config = load_config(None, [*args.settings, f"motor.port={args.motor}"])
    connected = ConnectedRobot(open_camera)
    return LiveRun(
        config, connected, lambda _, text: print(f"omnid: {text}", file=sys.stderr, flush=True), robot.rig
    ).run()


if __name__ == "__main__":
    sys.exit(main())
