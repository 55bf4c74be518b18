"""The part of the kernel's V4L2 interface that a camera needs: structures, request numbers and the ioctl call.

Source: linux/videodev2.h of Linux 6.1 and its documentation (userspace-api/media/v4l). The structures use the C
library's `long`, which makes them correct on 64-bit and on 32-bit machines; the latter use the kernel's old requests
with a 32-bit timeval, which CLOCK_MONOTONIC does not overflow.
"""

from __future__ import annotations

import ctypes
import fcntl
from typing import Final

CAPTURE: Final = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
MMAP: Final = 1  # V4L2_MEMORY_MMAP
PROGRESSIVE: Final = 1  # V4L2_FIELD_NONE

CAP_VIDEO_CAPTURE: Final = 0x00000001
CAP_STREAMING: Final = 0x04000000
CAP_DEVICE_CAPS: Final = 0x80000000

BUFFER_ERROR: Final = 0x40  # V4L2_BUF_FLAG_ERROR
TIMESTAMP_MASK: Final = 0xE000  # V4L2_BUF_FLAG_TIMESTAMP_MASK
TIMESTAMP_MONOTONIC: Final = 0x2000  # V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC

NEXT_CONTROL: Final = 0x80000000  # V4L2_CTRL_FLAG_NEXT_CTRL
CONTROL_DISABLED: Final = 0x01  # V4L2_CTRL_FLAG_DISABLED
CONTROL_READ_ONLY: Final = 0x04  # V4L2_CTRL_FLAG_READ_ONLY
CONTROL_INTEGER, CONTROL_BOOLEAN, CONTROL_MENU, CONTROL_INTEGER_MENU = 1, 2, 3, 9  # enum v4l2_ctrl_type

Int32 = ctypes.c_int32
_u8, _u32, _i32 = ctypes.c_uint8, ctypes.c_uint32, ctypes.c_int32


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = (
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", _u32),
        ("capabilities", _u32),
        ("device_caps", _u32),
        ("reserved", _u32 * 3),
    )


class Fraction(ctypes.Structure):
    """struct v4l2_fract."""

    _fields_ = (("numerator", _u32), ("denominator", _u32))


class PixelFormat(ctypes.Structure):
    """struct v4l2_pix_format."""

    _fields_ = (
        ("width", _u32),
        ("height", _u32),
        ("pixelformat", _u32),
        ("field", _u32),
        ("bytesperline", _u32),
        ("others", _u32 * 7),  # size of the image, colours
    )


class _AnyFormat(ctypes.Union):
    _fields_ = (("pix", PixelFormat), ("raw_data", _u8 * 200), ("pointer_alignment", ctypes.c_long))


class Format(ctypes.Structure):
    """struct v4l2_format."""

    _fields_ = (("type", _u32), ("fmt", _AnyFormat))


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm with the capture branch of its union, struct v4l2_captureparm."""

    _fields_ = (
        ("type", _u32),
        ("capability", _u32 * 2),  # and the mode of capture
        ("timeperframe", Fraction),
        ("others", _u8 * (200 - 4 * 4)),
    )


class BufferRequest(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = (("count", _u32), ("type", _u32), ("memory", _u32), ("capabilities", _u32), ("flags", _u32))


class _Timeval(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_usec", ctypes.c_long))


class _BufferMemory(ctypes.Union):
    _fields_ = (("offset", _u32), ("userptr", ctypes.c_long))


class V4l2Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _fields_ = (
        ("index", _u32),
        ("type", _u32),
        ("bytesused", _u32),
        ("flags", _u32),
        ("field", _u32),
        ("timestamp", _Timeval),
        ("timecode", _u32 * 4),
        ("sequence", _u32),
        ("memory", _u32),
        ("m", _BufferMemory),
        ("length", _u32),
        ("others", _u32 * 2),
    )

    @property
    def stamp_ns(self) -> int:
        """The kernel's stamp [ns]; the flags name its clock."""
        return int(self.timestamp.tv_sec) * 10**9 + int(self.timestamp.tv_usec) * 1000


class QueryControl(ctypes.Structure):
    """struct v4l2_queryctrl."""

    _fields_ = (
        ("id", _u32),
        ("type", _u32),
        ("name", ctypes.c_char * 32),
        ("minimum", _i32),
        ("maximum", _i32),
        ("step", _i32),
        ("default_value", _i32),
        ("flags", _u32),
        ("reserved", _u32 * 2),
    )


class QueryMenu(ctypes.Structure):
    """struct v4l2_querymenu; of an integer menu the first 8 bytes of name are a number."""

    _fields_ = (("id", _u32), ("index", _u32), ("name", ctypes.c_char * 32), ("reserved", _u32))


class V4l2Control(ctypes.Structure):
    """struct v4l2_control."""

    _fields_ = (("id", _u32), ("value", _i32))


_WRITE, _READ = 1, 2  # _IOC_WRITE, _IOC_READ


def _request(direction: int, number: int, argument: type[ctypes.Structure] | type[Int32]) -> int:
    """Return the request number: _IOC of asm-generic/ioctl.h for the type 'V'."""
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


QUERYCAP: Final = _request(_READ, 0, Capability)
G_FMT: Final = _request(_READ | _WRITE, 4, Format)
S_FMT: Final = _request(_READ | _WRITE, 5, Format)
REQBUFS: Final = _request(_READ | _WRITE, 8, BufferRequest)
QUERYBUF: Final = _request(_READ | _WRITE, 9, V4l2Buffer)
QBUF: Final = _request(_READ | _WRITE, 15, V4l2Buffer)
DQBUF: Final = _request(_READ | _WRITE, 17, V4l2Buffer)
STREAMON: Final = _request(_WRITE, 18, Int32)
STREAMOFF: Final = _request(_WRITE, 19, Int32)
G_PARM: Final = _request(_READ | _WRITE, 21, StreamParameters)
S_PARM: Final = _request(_READ | _WRITE, 22, StreamParameters)
G_CTRL: Final = _request(_READ | _WRITE, 27, V4l2Control)
S_CTRL: Final = _request(_READ | _WRITE, 28, V4l2Control)
QUERYCTRL: Final = _request(_READ | _WRITE, 36, QueryControl)
QUERYMENU: Final = _request(_READ | _WRITE, 37, QueryMenu)


def call(fd: int, request: int, argument: ctypes.Structure | Int32) -> None:
    """Pass the argument to the driver, which writes its result into it; raise OSError with the driver's errno."""
    fcntl.ioctl(fd, request, argument, True)


def fourcc(code: int) -> str:
    """Return the four letters of a pixel format, such as 'YUYV'."""
    return code.to_bytes(4, "little").decode("latin-1").rstrip()


def fourcc_code(letters: str) -> int:
    """Return the number of a pixel format given by its four letters."""
    return int.from_bytes(letters.ljust(4).encode("latin-1"), "little")
