"""One opening of a capture device: configured, mapped and streaming until it is closed."""

from __future__ import annotations

import errno
import mmap
import os
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_controls import apply_controls, list_controls, plan_controls
from drivers.cameras.v4l2_exposure import ExposureControls
from drivers.cameras.v4l2_modes import BYTES_PER_PIXEL, ENCODINGS, RATE_TOLERANCE, choose_format, list_modes
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError

_MIN_BUFFERS: Final = 2  # one to fill while the other is read
_MILLIHERTZ: Final = 1000  # rates are requested as whole thousandths of 1 Hz
_ADVICE: Final = {
    errno.ENOENT: "is not there; check the cable and the name, `omnid cameras` lists the cameras",
    errno.EACCES: "may not be read by this user; add the user to group video and log in again",
    errno.EPERM: "may not be read by this service; allow char-video4linux in its DeviceAllow",
    errno.EBUSY: "is used by another program; stop it (`fuser -v` names it)",
    errno.ENODEV: "is gone; check the cable",
    errno.ENXIO: "is gone; check the cable",
    errno.ENOTTY: "is not a video device; `omnid cameras` lists those that are",
    errno.ENOSPC: "gets no bandwidth on its USB bus; choose MJPG, a smaller image, a lower rate or another port",
}


@dataclass(frozen=True, slots=True)
class StreamFormat:
    """Format, size and rate in force of the images of a stream."""

    pixel_format: str  # four letters
    width_px: int
    height_px: int
    step: int  # bytes from row to row, 0 if compressed
    rate_hz: float  # 0: unknown

    @property
    def encoding(self) -> str:
        """The name of the format in a Frame."""
        return ENCODINGS[self.pixel_format]

    @property
    def min_bytes(self) -> int:
        """Size of the smallest complete image [bytes]; of NV12, whose chroma is not needed, the luma plane."""
        return max(1, self.step * self.height_px)

    def __str__(self) -> str:
        rate = f" at {self.rate_hz:.4g} Hz" if self.rate_hz else ""
        return f"{self.pixel_format} {self.width_px}x{self.height_px}{rate}"


def device_error(device: str, error: OSError) -> DriverError:
    """Return a DriverError that explains a system error of a device and advises what to do."""
    advice = _ADVICE.get(error.errno or 0, f"failed ({error.strerror or error}); unplug it and plug it in again")
    return DriverError(f"camera {device} {advice}")


class V4l2Stream:
    """A device opened for this program alone; raises DriverError where it cannot be opened or configured."""

    def __init__(self, settings: V4l2Settings) -> None:
        self._resources = ExitStack()
        try:
            self.fd = os.open(settings.device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
            self._resources.callback(os.close, self.fd)
            self.bus_info = _require_capture(self.fd)
            self.image = _set_image(self.fd, settings)
            self._maps = [self._mapped(index) for index in range(_request_buffers(self.fd, settings.buffers))]
            apply_controls(self.fd, plan_controls(settings, list_controls(self.fd)))
            self.exposure = ExposureControls(self.fd, with_gain=settings.gain < 0 and settings.auto_gain == "keep")
            self._resources.callback(_release, self.exposure)
            self._start()
        except OSError as error:
            self._resources.close()
            raise device_error(settings.device, error) from error
        except DriverError as error:
            self._resources.close()
            raise DriverError(f"camera {settings.device}: {error}") from error
        except BaseException:
            self._resources.close()
            raise

    def take(self) -> tuple[v4l2.V4l2Buffer, bytes] | None:
        """Return the oldest filled buffer and a copy of its bytes, None if there is none.

        Raises OSError for a lost device.
        """
        buffer = v4l2.V4l2Buffer(type=v4l2.CAPTURE, memory=v4l2.MMAP)
        try:
            v4l2.call(self.fd, v4l2.DQBUF, buffer)
        except BlockingIOError:
            return None
        data = self._maps[buffer.index][: buffer.bytesused]
        taken = v4l2.V4l2Buffer.from_buffer_copy(buffer)  # QBUF overwrites the structure
        v4l2.call(self.fd, v4l2.QBUF, buffer)
        return taken, data

    def close(self) -> None:
        """Release the device, lost or not; may be called twice."""
        self._resources.close()

    def _mapped(self, index: int) -> mmap.mmap:
        buffer = v4l2.V4l2Buffer(index=index, type=v4l2.CAPTURE, memory=v4l2.MMAP)
        v4l2.call(self.fd, v4l2.QUERYBUF, buffer)
        mapped = mmap.mmap(self.fd, buffer.length, flags=mmap.MAP_SHARED, prot=mmap.PROT_READ, offset=buffer.m.offset)
        self._resources.callback(mapped.close)
        return mapped

    def _start(self) -> None:
        for index in range(len(self._maps)):
            v4l2.call(self.fd, v4l2.QBUF, v4l2.V4l2Buffer(index=index, type=v4l2.CAPTURE, memory=v4l2.MMAP))
        self._resources.callback(_stop, self.fd)
        v4l2.call(self.fd, v4l2.STREAMON, v4l2.Int32(v4l2.CAPTURE))


def query_capability(fd: int) -> v4l2.Capability:
    """Return the identity of the device and the capabilities of this node of it (`device_caps`)."""
    found = v4l2.Capability()
    v4l2.call(fd, v4l2.QUERYCAP, found)
    if not found.capabilities & v4l2.CAP_DEVICE_CAPS:
        found.device_caps = found.capabilities
    return found


def _require_capture(fd: int) -> str:
    """Return the bus_info of a capture device: where it is plugged in; raise DriverError for any other device."""
    found = query_capability(fd)
    needed = v4l2.CAP_VIDEO_CAPTURE | v4l2.CAP_STREAMING
    if found.device_caps & needed != needed:
        raise DriverError(
            "is no capture device now; `omnid cameras` lists those that are (a loopback device is one "
            "only while a program writes to it)"
        )
    return str(found.bus_info.decode("utf-8", "replace"))


def _set_image(fd: int, settings: V4l2Settings) -> StreamFormat:
    """Set format, size and rate, and return those in force; raise DriverError where they differ."""
    size = settings.width_px, settings.height_px
    name = choose_format(list_modes(fd), settings.pixel_format, size, settings.rate_hz)
    requested = v4l2.Format(type=v4l2.CAPTURE)
    requested.fmt.pix.width, requested.fmt.pix.height = size
    requested.fmt.pix.pixelformat, requested.fmt.pix.field = v4l2.fourcc_code(name), v4l2.PROGRESSIVE
    v4l2.call(fd, v4l2.S_FMT, requested)
    in_force = v4l2.Format(type=v4l2.CAPTURE)
    v4l2.call(fd, v4l2.G_FMT, in_force)
    pix = in_force.fmt.pix
    found_name = v4l2.fourcc(pix.pixelformat)
    if (found_name, pix.width, pix.height) != (name, *size):
        raise DriverError(
            f"{name} {size[0]}x{size[1]} was requested, the device set {found_name} "
            f"{pix.width}x{pix.height}; choose a mode that `omnid cameras` lists"
        )
    row_bytes = BYTES_PER_PIXEL.get(name, 0) * pix.width
    step = max(row_bytes, pix.bytesperline) if row_bytes else 0
    return StreamFormat(name, pix.width, pix.height, step, _set_rate(fd, settings))


def _set_rate(fd: int, settings: V4l2Settings) -> float:
    """Set the rate and return the one in force [Hz], 0 where it is unknown; raise DriverError where they differ."""
    if settings.rate_hz:
        requested = v4l2.StreamParameters(type=v4l2.CAPTURE)
        requested.timeperframe = v4l2.Fraction(_MILLIHERTZ, round(settings.rate_hz * _MILLIHERTZ))
        with suppress(OSError):  # the rate in force is read next
            v4l2.call(fd, v4l2.S_PARM, requested)
    found_hz = _rate(fd)
    if settings.rate_hz and abs(found_hz - settings.rate_hz) > RATE_TOLERANCE * settings.rate_hz:
        found = f"set {found_hz:.4g} Hz" if found_hz else "has no rate to set"
        raise DriverError(
            f"{settings.rate_hz:g} Hz was requested, the device {found}; "
            "choose a rate that `omnid cameras` lists, or 0 for the device's own"
        )
    return found_hz


def _rate(fd: int) -> float:
    found = v4l2.StreamParameters(type=v4l2.CAPTURE)
    try:
        v4l2.call(fd, v4l2.G_PARM, found)
    except OSError:
        return 0.0
    interval = found.timeperframe
    return float(interval.denominator / interval.numerator) if interval.numerator else 0.0


def _request_buffers(fd: int, count: int) -> int:
    """Allocate buffers and return their number; from now on other programs get EBUSY.

    Raises DriverError where there are fewer than 2.
    """
    request = v4l2.BufferRequest(count=count, type=v4l2.CAPTURE, memory=v4l2.MMAP)
    v4l2.call(fd, v4l2.REQBUFS, request)
    if request.count < _MIN_BUFFERS:
        raise DriverError(
            f"{count} buffers were requested, the device gave {request.count}; streaming needs {_MIN_BUFFERS}"
        )
    return int(request.count)


def _release(exposure: ExposureControls) -> None:
    with suppress(OSError):  # a device that is gone starts with its automatic modes
        exposure.release()


def _stop(fd: int) -> None:
    with suppress(OSError):  # a device that is gone streams no more
        v4l2.call(fd, v4l2.STREAMOFF, v4l2.Int32(v4l2.CAPTURE))
