"""The part of the kernel's V4L2 interface that a camera needs: structures, request numbers and the ioctl call.

Source: linux/videodev2.h of Linux 6.1 and its documentation (userspace-api/media/v4l). The structures use the C
library's `long`, which makes them correct on 64-bit and on 32-bit machines; the latter use the kernel's old requests
with a 32-bit timeval, which CLOCK_MONOTONIC does not overflow.
"""

from __future__ import annotations

import ctypes
import fcntl
from typing import Any, ClassVar, Final, TypeAlias

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
CONTROL_UNUSABLE: Final = 0x01 | 0x04  # V4L2_CTRL_FLAG_DISABLED, V4L2_CTRL_FLAG_READ_ONLY

Int32 = ctypes.c_int32
_u32 = ctypes.c_uint32
_Fields: TypeAlias = list[tuple[str, type[Any]]]


def _words(names: str, kind: type[Any] = _u32) -> _Fields:
    """Return fields of 32 bits each."""
    return [(name, kind) for name in names.split()]


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _names: ClassVar[_Fields] = [("driver", ctypes.c_char * 16), ("card", ctypes.c_char * 32)]
    _fields_ = (
        *_names,
        ("bus_info", ctypes.c_char * 32),
        *_words("version capabilities device_caps"),
        ("others", _u32 * 3),
    )


class Fraction(ctypes.Structure):
    """struct v4l2_fract."""

    _fields_ = _words("numerator denominator")


class PixelFormat(ctypes.Structure):
    """struct v4l2_pix_format; others: size of the image, colours."""

    _fields_ = (*_words("width height pixelformat field bytesperline"), ("others", _u32 * 7))


class _AnyFormat(ctypes.Union):
    _fields_ = (("pix", PixelFormat), ("raw_data", ctypes.c_uint8 * 200), ("pointer_alignment", ctypes.c_long))


class Format(ctypes.Structure):
    """struct v4l2_format."""

    _fields_ = (("type", _u32), ("fmt", _AnyFormat))


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm with the capture branch of its union of 200 bytes, struct v4l2_captureparm."""

    _fields_ = (*_words("type capability mode"), ("timeperframe", Fraction), ("others", _u32 * 46))


class BufferRequest(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = _words("count type memory capabilities flags")


class _Timeval(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_usec", ctypes.c_long))


class _BufferMemory(ctypes.Union):
    _fields_ = (("offset", _u32), ("userptr", ctypes.c_long))


class V4l2Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _begin: ClassVar[_Fields] = [*_words("index type bytesused flags field"), ("timestamp", _Timeval)]
    _timecode: ClassVar[_Fields] = [("timecode", _u32 * 4), *_words("sequence memory")]
    _fields_ = (*_begin, *_timecode, ("m", _BufferMemory), *_words("length reserved request_fd"))

    @property
    def stamp_ns(self) -> int:
        """The kernel's stamp [ns]; the flags name its clock."""
        return int(self.timestamp.tv_sec) * 10**9 + int(self.timestamp.tv_usec) * 1000


class QueryControl(ctypes.Structure):
    """struct v4l2_queryctrl."""

    _values: ClassVar[_Fields] = _words("minimum maximum step default_value", Int32)
    _fields_ = (*_words("id type"), ("name", ctypes.c_char * 32), *_values, *_words("flags reserved1 reserved2"))


class V4l2Control(ctypes.Structure):
    """struct v4l2_control."""

    _fields_ = (("id", _u32), ("value", Int32))


_WRITE, _READ = 1, 2  # _IOC_WRITE, _IOC_READ


def _request(direction: int, number: int, argument: type[ctypes.Structure] | type[Int32]) -> int:
    """Return the request number: _IOC of asm-generic/ioctl.h for the type 'V'."""
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


QUERYCAP: Final = _request(_READ, 0, Capability)
S_FMT: Final = _request(_READ | _WRITE, 5, Format)
REQBUFS: Final = _request(_READ | _WRITE, 8, BufferRequest)
QUERYBUF: Final = _request(_READ | _WRITE, 9, V4l2Buffer)
QBUF: Final = _request(_READ | _WRITE, 15, V4l2Buffer)
DQBUF: Final = _request(_READ | _WRITE, 17, V4l2Buffer)
STREAMON: Final = _request(_WRITE, 18, Int32)
G_PARM: Final = _request(_READ | _WRITE, 21, StreamParameters)
S_PARM: Final = _request(_READ | _WRITE, 22, StreamParameters)
G_CTRL: Final = _request(_READ | _WRITE, 27, V4l2Control)
S_CTRL: Final = _request(_READ | _WRITE, 28, V4l2Control)
QUERYCTRL: Final = _request(_READ | _WRITE, 36, QueryControl)


def call(fd: int, request: int, argument: ctypes.Structure | Int32) -> None:
    """Pass the argument to the driver, which writes its result into it; raise OSError with the driver's errno."""
    fcntl.ioctl(fd, request, argument, True)


def fourcc(code: int) -> str:
    """Return the four letters of a pixel format, such as 'YUYV'."""
    return code.to_bytes(4, "little").decode("latin-1").rstrip()


def fourcc_code(letters: str) -> int:
    """Return the number of a pixel format given by its four letters."""
    return int.from_bytes(letters.ljust(4).encode("latin-1"), "little")
