"""One camera whose images hold both views of a rig, as two sources: one stream, the same data, the same stamps."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Protocol

from drivers.cameras.camera_state import CameraState
from drivers.frame import Frame, FrameSource


class StatefulSource(FrameSource, Protocol):
    """A source of frames with a state for the status."""

    state: CameraState


class SharedCamera:
    """The sources of both cameras of a rig over one camera, which `lower` reads; the frames of both share their data.

    Each camera of a run has a thread and an inbox of its own. `upper` delivers the newest frame that `lower` has read
    and it has not delivered; where its thread is late, older ones are dropped. It ends when `lower` does.
    """

    def __init__(self, camera: StatefulSource) -> None:
        self._newest = _Newest()
        self.lower: StatefulSource = _Lower(camera, self._newest)
        self.upper: StatefulSource = _Upper(camera.state, self._newest)


class _Newest:
    """The newest frame, handed from one thread to another."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._frame: Frame | None = None
        self._ended = False

    def put(self, frame: Frame) -> None:
        with self._changed:
            self._frame = frame
            self._changed.notify_all()

    def end(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def take(self) -> Frame | None:
        """Return the frame once there is one; None at the end, after the last one."""
        with self._changed:
            self._changed.wait_for(lambda: self._frame is not None or self._ended)
            frame, self._frame = self._frame, None
            return frame


class _Lower:
    """The lower view, whose reader reads the camera."""

    def __init__(self, camera: StatefulSource, newest: _Newest) -> None:
        self._camera, self._newest = camera, newest
        self.state = camera.state

    def frames(self) -> Iterator[Frame]:
        """Yield the camera's frames."""
        frames = self._camera.frames()
        try:
            for frame in frames:
                self._newest.put(replace(frame, camera="upper"))
                yield frame
        finally:
            self._newest.end()
            with suppress(AttributeError):
                frames.close()  # type: ignore[attr-defined]  # a generator holds the device until it is closed

    def close(self) -> None:
        """Close the camera."""
        self._camera.close()
        self._newest.end()


class _Upper:
    """The upper view: the frames that the reader of the lower one has read."""

    def __init__(self, state: CameraState, newest: _Newest) -> None:
        self._newest = newest
        self.state = state

    def frames(self) -> Iterator[Frame]:
        """Yield the newest frames until the end."""
        while (frame := self._newest.take()) is not None:
            yield frame

    def close(self) -> None:
        """End frames()."""
        self._newest.end()
