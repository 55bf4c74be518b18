"""A V4L2 camera as a source of frames that survives being unplugged."""

from __future__ import annotations

import logging
import os
import select
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from drivers.backoff import Backoff
from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import CameraExposure, CameraState
from drivers.cameras.v4l2_device import V4l2Stream, device_error
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError, EventCallback, ignore_event
from drivers.frame import Camera, Frame

_PAUSE_S: Final = 0.005  # Pause where poll() reports a device as ready and no buffer is filled.
_SEQUENCE_COUNT: Final = 2**32  # v4l2_buffer.sequence is an unsigned 32-bit counter
_MOST_JITTER_NS: Final = 500_000_000  # no delay of a camera that delivers images varies by more
_MAX_AGE_NS: Final = 10 * 10**9  # no driver keeps a buffer for longer; an older stamp is from another clock


class V4l2Camera:
    """The camera at settings.device, streaming from construction on.

    Raises DriverError where the device cannot be opened or does not take the settings. Later faults of the device
    raise nothing: it is released, reported once by `on_event`, and opened again by the same path with all its
    settings until it is back. `state` may be read from any thread.
    """

    def __init__(self, settings: V4l2Settings, camera: Camera, *, on_event: EventCallback = ignore_event) -> None:
        self._streams = deque([V4l2Stream(settings)])  # at most one; the thread that pops it closes it
        self.state = CameraState(mode=str(self._streams[0].image))
        controls = self._streams[0].exposure
        if settings.is_regulated and controls.ranges is not None:
            self.state.exposure = CameraExposure(controls.ranges, in_force=controls.read())
        self._settings, self._camera, self._on_event = settings, camera, on_event
        self._name = f"{camera} camera"
        self._accounting = BufferAccounting(self.state)
        self._stamps = StampValidator(self._name, self.state, on_event)
        self._wake = _WakeEvent()
        self._closing = self._reading = False
        self._bus_info = "" if Path(settings.device).is_symlink() else self._streams[0].bus_info

    def frames(self) -> Iterator[Frame]:
        """Yield the frames as they arrive, until `close`; those captured before the first call are discarded."""
        self._reading = True
        reopening = Backoff(self._settings.retry_s)
        try:
            self._discard()
            while not self._closing:
                delivered = self.state.frames
                try:
                    yield from self._images()
                except (OSError, DriverError) as error:
                    self._lose(error)
                    if self.state.frames > delivered:
                        reopening.reset()
                    self._wake.wait(reopening.next_s())
        finally:
            self._reading = False
            self._end()

    def close(self) -> None:
        """End `frames` at once, which then releases the device; release it here where `frames` is not running.

        May be called from any thread, any number of times.
        """
        self._closing = True  # before _reading is read; frames() writes and reads in the other order
        self._wake.set()
        if not self._reading:
            self._end()

    def _images(self) -> Iterator[Frame]:
        """Yield the frames of one opening; raise OSError or DriverError at its end, unless closing."""
        stream = self._streams[0] if self._streams else self._reopened()
        image = stream.image
        self._accounting.restart()
        if self.state.status == "lost" and self._next(stream) is None:
            return  # the first image after reopening is skipped: it may be old (v4l2loopback) or dark (webcams)
        while (filled := self._next(stream)) is not None:
            stamp_ns, data = filled
            if self.state.exposure is not None:
                stream.exposure.follow(self.state.exposure, stamp_ns)
            seq = self._counted()
            yield Frame(seq, stamp_ns, self._camera, image.encoding, data, image.width_px, image.height_px, image.step)

    def _next(self, stream: V4l2Stream) -> tuple[int, bytes] | None:
        """Return stamp and bytes of the next valid image, None when closing; raise DriverError at the timeout."""
        deadline_s = time.monotonic() + self._settings.timeout_s
        while not self._closing:
            if self._wake.wait_for(stream.fd, deadline_s - time.monotonic()):
                filled, arrival_ns = stream.dequeue(), time.monotonic_ns()
                if filled is None:
                    self._wake.wait(_PAUSE_S)
                elif self._accounting.accept(filled[0], stream.image.min_bytes):
                    return self._stamps.validate(filled[0], arrival_ns), filled[1]
            if time.monotonic() > deadline_s and not self._closing:
                raise DriverError(
                    f"camera {self._settings.device} sent no valid image for "
                    f"{self._settings.timeout_s:g} s; check its cable and power"
                )
        return None

    def _counted(self) -> int:
        """Return the number of the next frame; the first one after a loss is reported."""
        if self.state.status == "lost":
            self._on_event(logging.INFO, f"{self._name}: back, {self.state.mode}")
        self.state.status, self.state.problem = "streaming", ""
        self.state.frames += 1
        return self.state.frames - 1

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
        """Open the device again; raise DriverError too where its name now belongs to another camera."""
        stream = V4l2Stream(self._settings)
        self._streams.append(stream)
        self.state.reopens += 1
        if self._bus_info and stream.bus_info != self._bus_info:
            raise DriverError(
                f"camera {self._settings.device} was at {self._bus_info}, and is another one at "
                f"{stream.bus_info} now; use a persistent name, see `omnid cameras`"
            )
        self.state.mode = str(stream.image)
        if self.state.exposure is not None:
            self.state.exposure.problem = ""
        return stream

    def _discard(self) -> None:
        """Return the buffers that were filled before the first read."""
        with suppress(OSError):  # a lost device raises again at the next read
            while not self._closing and self._streams and self._streams[0].dequeue():
                pass

    def _release(self) -> None:
        with suppress(IndexError):
            self._streams.pop().close()

    def _end(self) -> None:
        self._release()
        self.state.status = "closed"


class _WakeEvent:
    """An event that any thread may set; from then on it ends every wait."""

    def __init__(self) -> None:
        self._fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)

    def __del__(self) -> None:
        os.close(self._fd)  # not earlier: another thread may still call set()

    def set(self) -> None:
        """Set the event."""
        os.eventfd_write(self._fd, 1)

    def wait(self, timeout_s: float) -> None:
        """Return when the event is set, or after timeout_s."""
        self._poll((self._fd,), timeout_s)

    def wait_for(self, fd: int, timeout_s: float) -> bool:
        """True if the device is ready, or in error, before the event is set and before timeout_s is over."""
        return any(ready == fd for ready, _ in self._poll((self._fd, fd), timeout_s))

    @staticmethod
    def _poll(fds: tuple[int, ...], timeout_s: float) -> list[tuple[int, int]]:
        poll = select.poll()
        for fd in fds:
            poll.register(fd, select.POLLIN)
        return poll.poll(max(0.0, timeout_s) * 1000)  # ms


class BufferAccounting:
    """Count missing, broken and restarted buffers in the camera's state; reads no clock and no device."""

    def __init__(self, state: CameraState) -> None:
        self._state = state
        self._last_sequence: int | None = None

    def restart(self) -> None:
        """Expect the first sequence number of a new stream."""
        self._last_sequence = None

    def accept(self, buffer: v4l2.V4l2Buffer, min_bytes: int) -> bool:
        """Count a buffer, and those missing since the last one; True if it holds an image.

        min_bytes: size of the smallest complete image. A shorter buffer, or one with the driver's error flag, is
        counted as an error; a step of the sequence backwards counts as its restart.
        """
        if self._last_sequence is not None:
            step = (buffer.sequence - self._last_sequence) % _SEQUENCE_COUNT
            if 0 < step < _SEQUENCE_COUNT // 2:
                self._state.drops += step - 1
            else:
                self._state.restarts += 1
        self._last_sequence = buffer.sequence
        is_broken = bool(buffer.flags & v4l2.BUFFER_ERROR) or buffer.bytesused < min_bytes
        self._state.errors += is_broken
        return not is_broken


class StampValidator:
    """Accept plausible stamps, replace the others by the time of arrival less the least delay; reads no clock.

    Each kind of fault is reported once by `on_event`, with `name` in front.
    """

    def __init__(self, name: str, state: CameraState, on_event: EventCallback) -> None:
        self._name, self._state, self._on_event = name, state, on_event
        self._last_valid_ns = self._last_ns = -1  # stamps of the kernel and those that were returned
        self._least_delay_ns: int | None = None  # from valid stamps to their arrivals
        self._reported: set[str] = set()

    def validate(self, buffer: v4l2.V4l2Buffer, arrival_ns: int) -> int:
        """Return the capture time of a buffer [ns of CLOCK_MONOTONIC], strictly increasing from call to call.

        arrival_ns: time at which the buffer was taken from the driver, same clock. A stamp is valid if it is later
        than the last valid one and at most 10 s before the arrival. v4l2loopback does not declare its clock: its stamps
        are taken for CLOCK_MONOTONIC, with one warning.
        """
        if buffer.flags & v4l2.TIMESTAMP_MASK != v4l2.TIMESTAMP_MONOTONIC:
            self._report_once("clock", "its driver does not declare a clock for its stamps; CLOCK_MONOTONIC is assumed")
        stamp_ns = buffer.stamp_ns
        delay_ns, usual_ns = arrival_ns - stamp_ns, self._least_delay_ns or 0
        # A clock that fell back is later than its own last stamps again some time, but not than those returned since.
        fell_back = stamp_ns <= self._last_ns and delay_ns > usual_ns + _MOST_JITTER_NS
        if max(self._last_valid_ns, arrival_ns - _MAX_AGE_NS) < stamp_ns <= arrival_ns and not fell_back:
            self._last_valid_ns = stamp_ns
            self._least_delay_ns = delay_ns if self._least_delay_ns is None else min(self._least_delay_ns, delay_ns)
        else:
            self._state.restamped += 1
            self._report_once(
                "stamp",
                f"a stamp is {(stamp_ns - arrival_ns) / 1e6:.3f} ms after the arrival, or not after the stamp before; "
                "the time of arrival, less the least delay, is used for such images, which are counted",
            )
            stamp_ns = arrival_ns - usual_ns
        self._last_ns = max(stamp_ns, self._last_ns + 1)
        return self._last_ns

    def _report_once(self, kind: str, text: str) -> None:
        if kind not in self._reported:
            self._reported.add(kind)
            self._on_event(logging.WARNING, f"{self._name}: {text}")
