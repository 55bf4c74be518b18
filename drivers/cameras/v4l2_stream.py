"""One opening of a capture device: claimed, set, mapped and streaming, until it is closed."""

from __future__ import annotations

import errno
import mmap
import os
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Final

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_controls import apply, controls, planned
from drivers.cameras.v4l2_modes import BYTES_PER_PIXEL, ENCODINGS, RATE_TOLERANCE, choose, modes
from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError

_ADVICE: Final = {
    errno.ENOENT: "is not there; check the cable and the name, `omnid cameras` lists what is",
    errno.EACCES: "must not be read by this user; add the user to group video and log in again",
    errno.EPERM: "must not be read here; allow char-video4linux in the service's DeviceAllow",
    errno.EBUSY: "is used by another program; stop it (`fuser -v` tells which)",
    errno.ENODEV: "is gone; check the cable",
    errno.ENXIO: "is gone; check the cable",
    errno.ENOTTY: "is not a video device; `omnid cameras` lists those that are",
    errno.ENOSPC: "finds no bandwidth on its USB bus; choose MJPG, a smaller image, a lower rate or another port",
}


@dataclass(frozen=True, slots=True)
class CapturedImage:
    """The layout of the images of a stream."""

    pixel_format: str
    width_px: int
    height_px: int
    step: int  # bytes from row to row, 0 if compressed
    rate_hz: float  # 0: unknown

    @property
    def encoding(self) -> str:
        """Its name in a Frame."""
        return ENCODINGS[self.pixel_format]

    @property
    def least_bytes(self) -> int:
        """What a whole image has at least; of NV12 the luma."""
        return max(1, self.step * self.height_px)

    def __str__(self) -> str:
        rate = f" at {self.rate_hz:.4g} Hz" if self.rate_hz else ""
        return f"{self.pixel_format} {self.width_px}x{self.height_px}{rate}"


def explained(device: str, error: OSError) -> DriverError:
    """What a system error of a device means and what to do about it."""
    advice = _ADVICE.get(error.errno or 0, f"failed ({error.strerror or error}); unplug it and plug it in again")
    return DriverError(f"camera {device} {advice}")


class V4l2Stream:
    """A device that is this program's; DriverError in one line where it cannot be had or set as it was asked."""

    def __init__(self, settings: V4l2Settings) -> None:
        self._resources = ExitStack()
        try:
            self.fd = os.open(settings.device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
            self._resources.callback(os.close, self.fd)
            self.bus_info = _require_capture(self.fd)
            self.image = _set_image(self.fd, settings)
            self._maps = [self._mapped(index) for index in range(_claim(self.fd, settings.buffers))]
            apply(self.fd, planned(settings, controls(self.fd)))
            self._start()
        except OSError as error:
            self._resources.close()
            raise explained(settings.device, error) from error
        except DriverError as error:
            self._resources.close()
            raise DriverError(f"camera {settings.device}: {error}") from error
        except BaseException:
            self._resources.close()
            raise

    def take(self) -> tuple[v4l2.V4l2Buffer, bytes] | None:
        """The oldest buffer that is full and a copy of its bytes; None if there is none. OSError for a lost device."""
        buffer = v4l2.V4l2Buffer(type=v4l2.CAPTURE, memory=v4l2.MMAP)
        try:
            v4l2.call(self.fd, v4l2.DQBUF, buffer)
        except BlockingIOError:
            return None
        data = self._maps[buffer.index][: buffer.bytesused]
        taken = v4l2.V4l2Buffer.from_buffer_copy(buffer)  # the driver writes into what it is given back
        v4l2.call(self.fd, v4l2.QBUF, buffer)
        return taken, data

    def close(self) -> None:
        """Lets go of the device, lost or not; may be called twice."""
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
        v4l2.call(self.fd, v4l2.STREAMON, v4l2.Number(v4l2.CAPTURE))


def capability(fd: int) -> v4l2.Capability:
    """Who the device is and what this node of it can do (`device_caps`)."""
    found = v4l2.Capability()
    v4l2.call(fd, v4l2.QUERYCAP, found)
    if not found.capabilities & v4l2.CAP_DEVICE_CAPS:
        found.device_caps = found.capabilities
    return found


def _require_capture(fd: int) -> str:
    """Where the device is plugged in."""
    found = capability(fd)
    needed = v4l2.CAP_VIDEO_CAPTURE | v4l2.CAP_STREAMING
    if found.device_caps & needed != needed:
        raise DriverError("is no capture device now; `omnid cameras` lists those that are (a loopback is one only "
                          "while somebody writes to it)")
    return str(found.bus_info.decode("utf-8", "replace"))


def _set_image(fd: int, settings: V4l2Settings) -> CapturedImage:
    """Asks for format, size and rate, and gives what is in force; DriverError where that is something else."""
    size = settings.width_px, settings.height_px
    name = choose(modes(fd), settings.pixel_format, size, settings.rate_hz)
    asked = v4l2.Format(type=v4l2.CAPTURE)
    asked.fmt.pix.width, asked.fmt.pix.height = size
    asked.fmt.pix.pixelformat, asked.fmt.pix.field = v4l2.fourcc_code(name), v4l2.PROGRESSIVE
    v4l2.call(fd, v4l2.S_FMT, asked)
    given = v4l2.Format(type=v4l2.CAPTURE)
    v4l2.call(fd, v4l2.G_FMT, given)
    pix = given.fmt.pix
    found = v4l2.fourcc(pix.pixelformat), pix.width, pix.height
    if found != (name, *size):
        raise DriverError(f"{name} {size[0]}x{size[1]} was asked, the device gave {found[0]} {found[1]}x{found[2]}; "
                          "choose a mode that `omnid cameras` lists")
    row = BYTES_PER_PIXEL.get(name, 0) * pix.width
    return CapturedImage(name, pix.width, pix.height, max(row, pix.bytesperline) if row else 0, _set_rate(fd, settings))


def _set_rate(fd: int, settings: V4l2Settings) -> float:
    """The rate in force, 0 where the device does not tell it; asked for as whole thousandths of 1 Hz."""
    if settings.rate_hz:
        asked = v4l2.StreamParameters(type=v4l2.CAPTURE)
        asked.timeperframe = v4l2.Fraction(1000, round(settings.rate_hz * 1000))
        with suppress(OSError):  # what is in force is read next
            v4l2.call(fd, v4l2.S_PARM, asked)
    found_hz = _rate(fd)
    if settings.rate_hz and abs(found_hz - settings.rate_hz) > RATE_TOLERANCE * settings.rate_hz:
        found = f"gave {found_hz:.4g} Hz" if found_hz else "has no rate to set"
        raise DriverError(f"{settings.rate_hz:g} Hz was asked, the device {found}; "
                          "choose a rate that `omnid cameras` lists, or 0 for the device's own")
    return found_hz


def _rate(fd: int) -> float:
    found = v4l2.StreamParameters(type=v4l2.CAPTURE)
    try:
        v4l2.call(fd, v4l2.G_PARM, found)
    except OSError:
        return 0.0
    interval = found.timeperframe
    return float(interval.denominator / interval.numerator) if interval.numerator else 0.0


def _claim(fd: int, count: int) -> int:
    """How many buffers the driver gives; from now on nobody else can have the device."""
    request = v4l2.BufferRequest(count=count, type=v4l2.CAPTURE, memory=v4l2.MMAP)
    v4l2.call(fd, v4l2.REQBUFS, request)
    if request.count < 2:
        raise DriverError(f"{count} buffers were asked, the device gave {request.count}; it needs 2 to stream")
    return int(request.count)


def _stop(fd: int) -> None:
    with suppress(OSError):  # a device that is gone has stopped
        v4l2.call(fd, v4l2.STREAMOFF, v4l2.Number(v4l2.CAPTURE))
