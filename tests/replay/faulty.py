"""`omnid run` on a log whose cameras can be spoilt: lines on the standard input say which and how.

    upper mute      no more images          lower garbage   JPEGs of noise        both black   dark ones
    lower cut       halves of JPEGs           both ok         as they are
    clock 3600      the time of day is that many seconds ahead
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
from drivers.cameras.log_camera import LogCamera, LogImages
from drivers.frame import Camera, Frame, gray
from omnid.config import load_config
from omnid.runs.live import LiveRun

TIME, TIME_NS = time.time, time.time_ns


class SpoiltCamera(LogCamera):
    """A log's camera with something done to its images."""

    def __init__(self, images: LogImages, camera: Camera, epoch_ns: int, faults: dict[str, str]) -> None:
        super().__init__(images, camera, epoch_ns)
        self._camera, self._faults = camera, faults
        first = gray((images.lower if camera == "lower" else images.upper)[0][1])
        self._black = cv2.imencode(".jpg", np.zeros_like(first))[1].tobytes()
        self._rng = random.Random(1)

    def frames(self) -> Iterator[Frame]:
        """The images, spoilt."""
        for frame in super().frames():
            fault = self._faults.get(self._camera, "ok")
            if fault != "mute":
                yield replace(frame, data=self._spoilt(fault, bytes(frame.data)))

    def _spoilt(self, fault: str, data: bytes) -> bytes:
        match fault:
            case "garbage":
                return b"\xff\xd8\xff" + self._rng.randbytes(len(data)) + b"\xff\xd9"
            case "cut":
                return data[: len(data) // 2]
            case "black":
                return self._black
        return data


def obey(faults: dict[str, str]) -> None:
    """Takes the lines."""
    for line in sys.stdin:
        whom, fault = line.split()
        if whom == "clock":
            step_clock(int(fault))
            continue
        faults.update(dict.fromkeys(("lower", "upper") if whom == "both" else (whom,), fault))


def step_clock(step_s: int) -> None:
    """Stands for a step of the system's clock, which is not ours to set."""
    time.time = lambda: TIME() + step_s
    time.time_ns = lambda: TIME_NS() + step_s * 10**9


def main() -> int:
    """The exit code of the daemon."""
    parser = argparse.ArgumentParser()
    for name in ("--log", "--rig"):
        parser.add_argument(name, type=Path, required=True)
    parser.add_argument("--motor", required=True)
    parser.add_argument("--set", action="append", dest="settings", default=[])
    args = parser.parse_args()
    faults: dict[str, str] = {}
    threading.Thread(target=obey, args=(faults,), daemon=True).start()
    images, epoch_ns = LogImages.load(args.log), time.monotonic_ns()
    config = load_config(None, [*args.settings, f"motor.port={args.motor}"])
    live = LiveRun(config, lambda camera: SpoiltCamera(images, camera, epoch_ns, faults),
                lambda _, text: print(f"omnid: {text}", file=sys.stderr, flush=True), read_rig(args.rig))
    return live.run()


if __name__ == "__main__":
    sys.exit(main())
