"""A V4L2 camera as a source of frames that survives being unplugged."""

from __future__ import annotations

import logging
import select
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

from drivers.backoff import Backoff
from drivers.cameras.camera_state import CameraExposure, CameraState
from drivers.cameras.v4l2_device import (
    V4l2Settings,
    V4l2Stream,
    device_error,
    exposure_in_force,
    exposure_ranges,
    follow_request,
)
from drivers.cameras.v4l2_ioctl import BufferFlag, Int32, V4l2Buffer
from drivers.errors import DriverError, EventCallback
from drivers.frame import Camera, Frame

POLL_S: Final = 0.1  # longest wait until `close` is noticed
_PAUSE_S: Final = 0.005  # Pause where poll() reports a device as ready and no buffer is filled.


class V4l2Camera:
    """The camera at settings.device, streaming from construction on.

    Raises DriverError where the device cannot be opened or does not take the settings. Later faults of the device
    raise nothing: it is released, reported once by `on_event`, and opened again by the same path with all its
    settings until it is back. `state` may be read from any thread.
    """

    def __init__(self, settings: V4l2Settings, camera: Camera, *, on_event: EventCallback) -> None:
        self._streams = deque([V4l2Stream(settings)])  # at most one; the thread that pops it closes it
        self.state = CameraState(mode=str(self._streams[0].image))
        fd = self._streams[0].fd
        ranges = exposure_ranges(fd, settings) if settings.is_regulated else None
        if ranges is not None:
            self.state.exposure = CameraExposure(ranges, in_force=exposure_in_force(fd, ranges))
        self._settings, self._camera, self._on_event = settings, camera, on_event
        self._name = f"{camera} camera"
        self._checks = BufferChecks(self._name, self.state, settings.timeout_s, on_event)
        self._closing, self._reading = threading.Event(), False

    def frames(self) -> Iterator[Frame]:
        """Yield the frames as they arrive, until `close`; those captured before the first call are discarded."""
        self._reading = True
        reopening = Backoff()
        try:
            with suppress(OSError):  # a lost device raises again at the next read
                while not self._closing.is_set() and self._streams and self._streams[0].dequeue():
                    pass
            while not self._closing.is_set():
                delivered = self.state.frames
                try:
                    yield from self._images()
                except (OSError, DriverError) as error:
                    self._lose(error)
                    if self.state.frames > delivered:
                        reopening.reset()
                    self._closing.wait(reopening.next_s())
        finally:
            self._reading = False
            self._end()

    def close(self) -> None:
        """End `frames` within POLL_S, which then releases the device; release it here where `frames` is not running.

        May be called from any thread, any number of times.
        """
        self._closing.set()  # before _reading is read; frames() writes and reads in the other order
        if not self._reading:
            self._end()

    def _images(self) -> Iterator[Frame]:
        """Yield the frames of one opening; raise OSError or DriverError at its end, unless closing."""
        stream = self._streams[0] if self._streams else self._reopened()
        image = stream.image
        self._checks.last_sequence = None
        if self.state.status == "lost" and self._next(stream) is None:
            return  # the first image after reopening is skipped: it may be old (v4l2loopback) or dark (webcams)
        while (filled := self._next(stream)) is not None:
            stamp_ns, data = filled
            if self.state.exposure is not None:
                follow_request(stream.fd, self._settings, self.state.exposure, stamp_ns)
            if self.state.status == "lost":
                self._on_event(logging.INFO, f"{self._name}: back, {self.state.mode}")
            self.state.status, self.state.problem = "streaming", ""
            seq, self.state.frames = self.state.frames, self.state.frames + 1
            yield Frame(seq, stamp_ns, self._camera, image.encoding, data, image.width_px, image.height_px, image.step)

    def _next(self, stream: V4l2Stream) -> tuple[int, bytes] | None:
        """Return stamp and bytes of the next valid image, None when closing; raise DriverError at the timeout."""
        deadline_s = time.monotonic() + self._settings.timeout_s
        poll = select.poll()
        poll.register(stream.fd, select.POLLIN)
        while not self._closing.is_set():
            if poll.poll(POLL_S * 1000):  # ms
                filled, arrival_ns = stream.dequeue(), time.monotonic_ns()
                if filled is None:
                    self._closing.wait(_PAUSE_S)
                elif self._checks.accept(filled[0], stream.image.min_bytes):
                    return self._checks.stamp_ns(filled[0], arrival_ns), filled[1]
            if time.monotonic() > deadline_s and not self._closing.is_set():
                raise DriverError(
                    f"camera {self._settings.device} sent no valid image for "
                    f"{self._settings.timeout_s:g} s; check its cable and power"
                )
        return None

    def _lose(self, error: OSError | DriverError) -> None:
        """Release the device; report it unless it was lost before."""
        self._release()
        reason = device_error(self._settings.device, error) if isinstance(error, OSError) else error
        self.state.problem = str(reason)
        if self.state.status != "lost":
            self.state.status = "lost"
            self.state.losses += 1
            self._on_event(logging.WARNING, f"{self._name}: lost, and tried again until it is back: {reason}")

    def _reopened(self) -> V4l2Stream:
        """Open the device again; the newest request for its exposure is carried out again."""
        stream = V4l2Stream(self._settings)
        self._streams.append(stream)
        self.state.reopens += 1
        self.state.mode = str(stream.image)
        if self.state.exposure is not None:
            self.state.exposure.problem, self.state.exposure.done = "", None
        return stream

    def _release(self) -> None:
        with suppress(IndexError):
            self._streams.pop().close()

    def _end(self) -> None:
        self._release()
        self.state.status = "closed"


class BufferChecks:
    """Count missing, broken and restarted buffers, and replace implausible stamps; reads no clock and no device.

    Each kind of fault of the stamps is reported once by `on_event`, with `name` in front.
    """

    def __init__(self, name: str, state: CameraState, timeout_s: float, on_event: EventCallback) -> None:
        """timeout_s: without an image. A stamp that is older than five of it is from another clock.

        Younger ones wait in the driver while this program is held up: they are right.
        """
        self._name, self._state, self._on_event = name, state, on_event
        self._max_age_ns = round(5e9 * timeout_s)
        self.last_sequence: int | None = None  # None: the first buffer of a stream is awaited
        self._last_ns = -1
        self._least_delay_ns: int | None = None  # from valid stamps to their arrivals
        self._reported: set[str] = set()

    def accept(self, buffer: V4l2Buffer, min_bytes: int) -> bool:
        """Count a buffer, and those missing since the last one; True if it holds an image.

        min_bytes: size of the smallest complete image. A shorter buffer, or one with the driver's error flag, is
        counted as an error; a step of the sequence backwards counts as its restart.
        """
        if self.last_sequence is not None:
            step = Int32(buffer.sequence - self.last_sequence).value  # the counter has 32 bits, too
            if step > 0:
                self._state.drops += step - 1
            else:
                self._state.restarts += 1
        self.last_sequence = buffer.sequence
        is_broken = bool(buffer.flags & BufferFlag.ERROR) or buffer.bytesused < min_bytes
        self._state.errors += is_broken
        return not is_broken

    def stamp_ns(self, buffer: V4l2Buffer, arrival_ns: int) -> int:
        """Return the capture time of a buffer [ns of CLOCK_MONOTONIC], strictly increasing from call to call.

        arrival_ns: time at which the buffer was taken from the driver, same clock. A stamp is valid if it is later
        than the one before and at most five times timeout_s before the arrival; others are replaced by the arrival less
        the least delay. v4l2loopback does not declare its clock: its stamps are taken for CLOCK_MONOTONIC, with one
        warning.
        """
        if buffer.flags & BufferFlag.TIMESTAMP_MASK != BufferFlag.TIMESTAMP_MONOTONIC:
            self._report_once("its driver does not declare a clock for its stamps; CLOCK_MONOTONIC is assumed")
        stamp_ns, delay_ns = buffer.stamp_ns, arrival_ns - buffer.stamp_ns
        if max(self._last_ns, arrival_ns - self._max_age_ns) < stamp_ns <= arrival_ns:
            self._least_delay_ns = delay_ns if self._least_delay_ns is None else min(self._least_delay_ns, delay_ns)
        else:
            self._state.restamped += 1
            self._report_once("some stamps are not plausible; the times of arrival are used for these, and counted")
            stamp_ns = arrival_ns - (self._least_delay_ns or 0)
        self._last_ns = max(stamp_ns, self._last_ns + 1)
        return self._last_ns

    def _report_once(self, text: str) -> None:
        if text not in self._reported:
            self._reported.add(text)
            self._on_event(logging.WARNING, f"{self._name}: {text}")
