"""`omnid run` on a log whose cameras are made faulty by lines on the standard input.

upper mute      no more images          lower garbage   JPEGs of noise        both black   dark ones
both frozen     the same image again and again              both ok         no fault
clock 3600      the system clock is that many seconds ahead
"""

from __future__ import annotations

import argparse
import random
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from calib.rig_file import read_rig
from drivers.cameras.log_camera import LogCamera, LogPlayback
from drivers.frame import Camera, Frame, gray
from omnid.config import load_config
from omnid.engine.logging_setup import configure_logging
from omnid.runs.live import ConnectedRobot, run_live

TIME, TIME_NS = time.time, time.time_ns


class FaultyCamera(LogCamera):
    """A camera of a log with a fault in its images."""

    def __init__(self, playback: LogPlayback, camera: Camera, faults: dict[str, str]) -> None:
        super().__init__(playback, camera)
        self._faults = faults
        first = gray(playback.frames[camera][0][1])
        self._size, self._dark = first.shape, np.random.default_rng(len(camera))
        self._last = b""  # image without a fault
        self._rng = random.Random(1)

    def frames(self) -> Iterator[Frame]:
        """Yield the images with the fault."""
        for frame in super().frames():
            fault = self._faults.get(self._camera, "ok")
            if fault != "mute":
                yield replace(frame, data=self._with_fault(fault, bytes(frame.data)))

    def _with_fault(self, fault: str, data: bytes) -> bytes:
        match fault:
            case "garbage":
                return b"\xff\xd8\xff" + self._rng.randbytes(len(data)) + b"\xff\xd9"
            case "black":
                noise = self._dark.integers(0, 4, self._size, np.uint8)
                return cv2.imencode(".jpg", noise)[1].tobytes()
            case "frozen":
                return self._last
        self._last = data
        return data


def read_faults(faults: dict[str, str]) -> None:
    """Read faults from the standard input until it ends."""
    for line in sys.stdin:
        camera, fault = line.split()
        if camera == "clock":
            step_clock(int(fault))
            continue
        faults.update(dict.fromkeys(("lower", "upper") if camera == "both" else (camera,), fault))


def step_clock(step_s: int) -> None:
    """Set the clock of this process, in place of the system's."""
    time.time = lambda: TIME() + step_s
    time.time_ns = lambda: TIME_NS() + step_s * 10**9


def main() -> int:
    """Run the daemon and return its exit code."""
    parser = argparse.ArgumentParser()
    for name in ("--log", "--rig"):
        parser.add_argument(name, type=Path, required=True)
    parser.add_argument("--motor", required=True)
    parser.add_argument("--set", action="append", dest="settings", default=[])
    args = parser.parse_args()
    faults: dict[str, str] = {}
    threading.Thread(target=read_faults, args=(faults,), daemon=True).start()
    playback = LogPlayback(args.log)
    config = load_config(None, ["controller.motion.check=false", *args.settings, f"motor.port={args.motor}"])
    configure_logging()
    run_live(
        config,
        ConnectedRobot(lambda camera: FaultyCamera(playback, camera, faults)),
        read_rig(args.rig),
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
