"""A recorded log that replaces live cameras: at a chosen pace, stamped with the time of delivery."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TypeAlias

from drivers.cameras.camera_state import CameraState
from drivers.errors import DriverError
from drivers.frame import CAMERAS, Camera, Frame
from drivers.logs.log_reader import BY_NAME, LogCameras, LogReader

TimedFrames: TypeAlias = tuple[tuple[int, Frame], ...]  # time since the log's first frame [ns], frame


class LogPlayback:
    """The images of both cameras of a log, in memory, which are played forwards and backwards in turn.

    It starts when the first camera begins to deliver: a run that loads for some time before it takes images loses none
    of them. warnings: of the reader, a line each.
    """

    def __init__(self, log: Path, cameras: LogCameras = BY_NAME, *, pace: float = 1.0, once: bool = False) -> None:
        """Load the images; pace: speed relative to the recording. once: play once, forwards.

        Raise DriverError for a pace that is not above 0, and for fewer than two images of a camera.
        """
        if not 0 < pace < math.inf:
            raise DriverError(f"the pace of a log is {pace:g}; give a number above 0; 2 is twice as fast as recorded")
        with closing(LogReader(log, cameras)) as reader:
            frames = list(reader.frames())
        self.frames: dict[Camera, TimedFrames] = {
            camera: tuple((frame.stamp_ns - frames[0].stamp_ns, frame) for frame in frames if frame.camera == camera)
            for camera in CAMERAS
        }
        counts = [len(of_camera) for of_camera in self.frames.values()]
        if min(counts) < 2:
            raise DriverError(
                f"{log}: {counts[0]} images of the lower and {counts[1]} of the upper camera: give a log with two or "
                "more of each"
            )
        self.warnings = tuple(reader.warnings)
        self.pace, self._once = pace, once
        self._last_ns = max(of_camera[-1][0] for of_camera in self.frames.values())
        # From one pass to the next: the log and one period, the same for both cameras.
        self._pass_ns = self._last_ns + max(1, self._last_ns // (max(counts) - 1))
        self._epoch_ns: int | None = None
        self._lock = threading.Lock()

    def epoch_ns(self) -> int:
        """Return the start of the log [ns of CLOCK_MONOTONIC]; the first call, from any thread, starts it."""
        with self._lock:
            if self._epoch_ns is None:
                self._epoch_ns = time.monotonic_ns()
            return self._epoch_ns

    def due(self, camera: Camera, closed: threading.Event) -> Iterator[tuple[int, Frame]]:
        """Yield stamp [ns] and frame of a camera when each frame is due, until closed."""
        epoch_ns, frames = self.epoch_ns(), self.frames[camera]
        for number in count():
            is_backwards = number % 2 == 1
            for at_ns, frame in reversed(frames) if is_backwards else frames:
                after_ns = number * self._pass_ns + (self._last_ns - at_ns if is_backwards else at_ns)
                stamp_ns = epoch_ns + round(after_ns / self.pace)
                if closed.wait(max(0.0, (stamp_ns - time.monotonic_ns()) * 1e-9)):
                    return
                yield stamp_ns, frame
            if self._once:
                return


class LogCamera:
    """One camera of a log. The stamp of a frame is the time at which it is due."""

    def __init__(self, playback: LogPlayback, camera: Camera) -> None:
        self._playback, self._camera = playback, camera
        self._closed = threading.Event()
        self.state = CameraState(mode="a recorded log")

    def frames(self) -> Iterator[Frame]:
        """Yield the frames when they are due, until closed."""
        for seq, (stamp_ns, frame) in enumerate(self._playback.due(self._camera, self._closed)):
            self.state.status = "streaming"
            self.state.frames += 1
            yield replace(frame, seq=seq, stamp_ns=stamp_ns)
        self.state.status = "closed"

    def close(self) -> None:
        """End the frames; may be called twice, from any thread."""
        self._closed.set()
