"""A webcam behind the ioctl call: formats, rates, controls and buffers as uvcvideo has them, on an ordinary file."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
from collections import deque
from pathlib import Path

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_ioctl import BufferFlag, Capability, ControlId

AUTO_GAIN, GAIN, _, AUTO_EXPOSURE, EXPOSURE, EXPOSURE_MAY_SLOW = ControlId
APERTURE_PRIORITY = 3
CONTRAST = 0x00980901


class FakeCamera:
    """Exposure and gain are refused while their mode is automatic."""

    def __init__(self, path: Path | None = None) -> None:
        self.controls = {  # id: name, low, high, step
            GAIN: ("Gain", 0, 255, 5),
            AUTO_GAIN: ("Gain, Automatic", 0, 1, 1),
            AUTO_EXPOSURE: ("Auto Exposure", 0, 3, 1),
            EXPOSURE: ("Exposure Time, Absolute", 3, 2047, 1),
            EXPOSURE_MAY_SLOW: ("Exposure, Dynamic Framerate", 0, 1, 1),
            CONTRAST: ("Contrast", -64, 64, 1),
        }
        self.values = dict.fromkeys(self.controls, 1) | {GAIN: 65, AUTO_EXPOSURE: APERTURE_PRIORITY, EXPOSURE: 156}
        self.menu = (1, APERTURE_PRIORITY)
        self.written: list[tuple[int, int]] = []
        self.failing = 0  # errno of every call but those that enumerate
        self.modes = {("YUYV", 640, 480): 30.0, ("YUYV", 1280, 960): 7.5, ("MJPG", 1280, 960): 30.0}
        self.filled: deque[tuple[bytes, int, int, int]] = deque()  # bytes, sequence, stamp [ns], flags
        self._mode, self._rate_hz = ("YUYV", 640, 480), 30.0
        if path is not None:
            path.write_bytes(bytes(2 * mmap.PAGESIZE))
        self._path = path

    def fill(self, sequence: int, stamp_ns: int, flags: int = BufferFlag.TIMESTAMP_MONOTONIC, size: int = 100) -> None:
        """Let a buffer be filled."""
        self.filled.append((bytes([sequence % 256]) * size, sequence, stamp_ns, flags))

    def call(self, fd: int, request: str, argument: ctypes.Structure) -> None:
        """Answer a call as the kernel does."""
        if self.failing and request != "QUERYCTRL":
            raise OSError(self.failing, os.strerror(self.failing))
        {
            "QUERYCAP": self._query_capability,
            "S_FMT": self._set_format,
            "S_PARM": self._set_rate,
            "G_PARM": self._get_rate,
            "QUERYCTRL": self._query_control,
            "G_CTRL": self._get_control,
            "S_CTRL": self._set_control,
            "QUERYBUF": self._query_buffer,
            "DQBUF": self._take_buffer,
        }.get(request, lambda _: None)(argument)

    def _query_capability(self, found: ctypes.Structure) -> None:
        found.device_caps = Capability.VIDEO_CAPTURE | Capability.STREAMING

    def _set_format(self, wanted: ctypes.Structure) -> None:
        pix = wanted.fmt.pix
        mode = (v4l2.fourcc(pix.pixelformat), pix.width, pix.height)
        others = [other for other in self.modes if other[0] == mode[0]] or list(self.modes)
        self._mode = mode if mode in self.modes else others[0]
        self._rate_hz = self.modes[self._mode]
        name, pix.width, pix.height = self._mode
        pix.pixelformat = v4l2.fourcc_code(name)

    def _set_rate(self, wanted: ctypes.Structure) -> None:
        interval = wanted.timeperframe
        self._rate_hz = min(self.modes[self._mode], interval.denominator / interval.numerator)

    def _get_rate(self, found: ctypes.Structure) -> None:
        found.timeperframe = v4l2.Fraction(1000, round(self._rate_hz * 1000))

    def _query_control(self, entry: ctypes.Structure) -> None:
        after = entry.id & ~v4l2.ControlFlag.NEXT_CTRL
        following = sorted(control for control in self.controls if control > after)
        if not following:
            raise OSError(errno.EINVAL, "no more")
        entry.id = following[0]
        name, entry.minimum, entry.maximum, entry.step = self.controls[following[0]]
        entry.name, entry.flags = name.encode(), 0

    def _get_control(self, control: ctypes.Structure) -> None:
        control.value = self.values[control.id]

    def _set_control(self, control: ctypes.Structure) -> None:
        automatic = {EXPOSURE: self.values[AUTO_EXPOSURE] != 1, GAIN: self.values.get(AUTO_GAIN) == 1}
        if automatic.get(control.id):
            raise OSError(errno.EACCES, "refused")
        if control.id == AUTO_EXPOSURE and control.value not in self.menu:
            raise OSError(errno.EINVAL, "not offered")
        self.values[control.id] = control.value
        self.written.append((control.id, control.value))

    def _query_buffer(self, buffer: ctypes.Structure) -> None:
        buffer.length, buffer.m.offset = mmap.PAGESIZE, (buffer.index % 2) * mmap.PAGESIZE

    def _take_buffer(self, buffer: ctypes.Structure) -> None:
        if not self.filled:
            raise BlockingIOError(errno.EAGAIN, "none")
        data, buffer.sequence, stamp_ns, buffer.flags = self.filled.popleft()
        buffer.timestamp.tv_sec, rest_ns = divmod(stamp_ns, 10**9)
        buffer.timestamp.tv_usec, buffer.bytesused, buffer.index = rest_ns // 1000, len(data), 0
        assert self._path is not None
        with self._path.open("r+b") as file:
            file.write(data)
