"""A V4L2 camera as a source of frames that outlives its unplugging."""

from __future__ import annotations

import os
import select
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_buffers import NOTICE, WARNING, BufferAccounting, CameraState, Report
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.cameras.v4l2_stream import V4l2Stream, explained
from drivers.errors import DriverError
from drivers.frame import Camera, Frame

_FIRST_RETRY_S: Final = 0.1
_SETTLED_FRAMES: Final = 30  # a device that comes and goes is waited for longer each time
_PAUSE_S: Final = 0.005  # where a driver signals an error but tells none


def unheard(severity: int, text: str) -> None:
    """A report that goes nowhere."""


class V4l2Camera:
    """The camera at settings.device, streaming from the start; DriverError where it cannot be had or set as asked.

    Once it has been opened, no fault of the device raises: it is let go, told of once by `report`, and opened again by
    the same path with all its settings until it is back. `state` may be read from any thread.
    """

    def __init__(self, settings: V4l2Settings, camera: Camera, *, report: Report = unheard) -> None:
        self._streams = deque([V4l2Stream(settings)])  # the open one, if any: to pop it is to own it
        self.state = CameraState(mode=str(self._streams[0].image))
        self._settings, self._camera, self._report = settings, camera, report
        self._name = f"{camera} camera"
        self._ledger = BufferAccounting(self._name, self.state, report)
        self._wake = _Wake()
        self._closing = self._reading = False
        self._bus_info = "" if Path(settings.device).is_symlink() else self._streams[0].bus_info

    def frames(self) -> Iterator[Frame]:
        """Gives the images as they come, until `close`; what was taken before the first call is not among them."""
        self._reading = True
        retry_s = _FIRST_RETRY_S
        try:
            self._discard()
            while not self._closing:
                given = self.state.frames
                try:
                    yield from self._images()
                except (OSError, DriverError) as error:
                    self._lose(error)
                    settled = self.state.frames - given > _SETTLED_FRAMES
                    retry_s = _FIRST_RETRY_S if settled else min(2 * retry_s, self._settings.retry_s)
                    self._wake.wait(retry_s)
        finally:
            self._reading = False
            self._end()

    def close(self) -> None:
        """Ends `frames`, which lets go of the device, at once; without it, lets go here. For any thread, any times."""
        self._closing = True  # before _reading is read; frames() writes and reads in the other order
        self._wake.set()
        if not self._reading:
            self._end()

    def _images(self) -> Iterator[Frame]:
        """The images of one opening; OSError or DriverError at its end, unless closing."""
        stream = self._streams[0] if self._streams else self._reopened()
        image = stream.image
        self._ledger.begin()
        if self.state.status == "lost" and self._next(stream) is None:
            return  # the first image anew is left out: it may be an old one (v4l2loopback) or a dark one (webcams)
        while (filled := self._next(stream)) is not None:
            stamp_ns, data = filled
            seq = self._counted()
            yield Frame(seq, stamp_ns, self._camera, image.encoding, data, image.width_px, image.height_px,
                        image.step)

    def _next(self, stream: V4l2Stream) -> tuple[int, bytes] | None:
        """Stamp and bytes of the next good image, None when closing; DriverError when none came in time."""
        deadline_s = time.monotonic() + self._settings.timeout_s
        while not self._closing:
            if self._wake.wait_for(stream.fd, deadline_s - time.monotonic()):
                filled = stream.take()
                if filled is None:
                    self._wake.wait(_PAUSE_S)
                elif (stamp_ns := self._admitted(filled[0], stream)) is not None:
                    return stamp_ns, filled[1]
            if time.monotonic() > deadline_s and not self._closing:
                raise DriverError(f"camera {self._settings.device} sent no good image for "
                                  f"{self._settings.timeout_s:g} s; check its cable and power")
        return None

    def _admitted(self, buffer: v4l2.V4l2Buffer, stream: V4l2Stream) -> int | None:
        return self._ledger.admit(buffer, time.monotonic_ns(), stream.image.least_bytes)

    def _counted(self) -> int:
        """The number of the image that is about to be given; with the first one the camera is here, or back."""
        if self.state.status == "lost":
            self._report(NOTICE, f"{self._name}: back, {self.state.mode}")
        self.state.status, self.state.problem = "streaming", ""
        self.state.frames += 1
        return self.state.frames - 1

    def _lose(self, error: OSError | DriverError) -> None:
        """Lets go of the device and says so, unless that is known."""
        self._release()
        reason = explained(self._settings.device, error) if isinstance(error, OSError) else error
        self.state.problem = str(reason)
        if self.state.status != "lost":
            self.state.status = "lost"
            self.state.losses += 1
            self._report(WARNING, f"{self._name}: lost, and tried again until it is back: {reason}")

    def _reopened(self) -> V4l2Stream:
        """The device opened anew; DriverError also where a name that is not stable now leads to another camera."""
        stream = V4l2Stream(self._settings)
        self._streams.append(stream)
        self.state.reopens += 1
        if self._bus_info and stream.bus_info != self._bus_info:
            raise DriverError(f"camera {self._settings.device} was at {self._bus_info}, there is now that at "
                              f"{stream.bus_info}; use a name that stays, see `omnid cameras`")
        self.state.mode = str(stream.image)
        return stream

    def _discard(self) -> None:
        """Gives back what filled up before anybody read."""
        with suppress(OSError):  # a device that was lost meanwhile says so again
            while not self._closing and self._streams and self._streams[0].take():
                pass

    def _release(self) -> None:
        with suppress(IndexError):
            self._streams.pop().close()

    def _end(self) -> None:
        self._release()
        self.state.status = "closed"


class _Wake:
    """A bell that any thread may ring, and that ends every wait from then on."""

    def __init__(self) -> None:
        self._fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def __del__(self) -> None:
        os.close(self._fd)  # not earlier: somebody may still ring

    def set(self) -> None:
        """Rings."""
        os.eventfd_write(self._fd, 1)

    def wait(self, timeout_s: float) -> None:
        """Returns when it rings, or after the time."""
        self._poll((self._fd,), timeout_s)

    def wait_for(self, fd: int, timeout_s: float) -> bool:
        """Whether the device has something to say, be it an error, before the bell rings and the time is over."""
        return any(ready == fd for ready, _ in self._poll((self._fd, fd), timeout_s))

    @staticmethod
    def _poll(fds: tuple[int, ...], timeout_s: float) -> list[tuple[int, int]]:
        poll = select.poll()
        for fd in fds:
            poll.register(fd, select.POLLIN)
        return poll.poll(max(0.0, timeout_s) * 1000)
