"""The part of the kernel's V4L2 interface that a camera needs: structures, request numbers and the ioctl call.

Source: linux/videodev2.h of Linux 6.1 and its documentation (userspace-api/media/v4l). The structures use the C
library's `long`, which makes them correct on 64-bit and on 32-bit machines; the latter use the kernel's old requests
with a 32-bit timeval, which CLOCK_MONOTONIC does not overflow.
"""

from __future__ import annotations

import ctypes
import fcntl
from enum import IntEnum, IntFlag
from typing import Any, ClassVar, Final, TypeAlias

# V4L2_BUF_TYPE_VIDEO_CAPTURE, V4L2_MEMORY_MMAP, V4L2_FIELD_NONE
CAPTURE = MMAP = PROGRESSIVE = 1


class Capability(IntFlag):
    """V4L2_CAP_*."""

    VIDEO_CAPTURE = 0x00000001
    STREAMING = 0x04000000


# V4L2_BUF_FLAG_*
BufferFlag = IntFlag("BufferFlag", {"ERROR": 0x40, "TIMESTAMP_MONOTONIC": 0x2000, "TIMESTAMP_MASK": 0xE000})


class ControlFlag(IntFlag):
    """V4L2_CTRL_FLAG_*."""

    DISABLED = 0x01
    READ_ONLY = 0x04
    NEXT_CTRL = 0x80000000


# V4L2_CID_* of linux/v4l2-controls.h; by EXPOSURE_AUTO_PRIORITY automatic exposure may lower the rate.
ControlId = IntEnum(
    "ControlId",
    {
        "AUTO_GAIN": 0x00980912,
        "GAIN": 0x00980913,
        "POWER_LINE_FREQUENCY": 0x00980918,
        "AUTO_EXPOSURE": 0x009A0901,
        "EXPOSURE": 0x009A0902,
        "EXPOSURE_AUTO_PRIORITY": 0x009A0903,
    },
)


class ExposureMode(IntEnum):
    """enum v4l2_exposure_auto_type; USB cameras offer APERTURE_PRIORITY in place of AUTO."""

    AUTO = 0
    MANUAL = 1
    APERTURE_PRIORITY = 3


Int32 = ctypes.c_int32
_u32 = ctypes.c_uint32
_Fields: TypeAlias = list[tuple[str, type[Any]]]


def _u32s(names: str) -> _Fields:
    """Return fields of type __u32."""
    return [(name, _u32) for name in names.split()]


class DeviceCapability(ctypes.Structure):
    """struct v4l2_capability."""

    _names: ClassVar[_Fields] = [("driver", ctypes.c_char * 16), ("card", ctypes.c_char * 32)]
    _fields_ = (
        *_names,
        ("bus_info", ctypes.c_char * 32),
        *_u32s("version capabilities device_caps"),
        ("others", _u32 * 3),
    )


class Fraction(ctypes.Structure):
    """struct v4l2_fract."""

    _fields_ = _u32s("numerator denominator")


class PixelFormat(ctypes.Structure):
    """struct v4l2_pix_format; others: size of the image, colours."""

    _fields_ = (*_u32s("width height pixelformat field bytesperline"), ("others", _u32 * 7))


class _AnyFormat(ctypes.Union):
    _fields_ = (("pix", PixelFormat), ("raw_data", ctypes.c_uint8 * 200), ("pointer_alignment", ctypes.c_long))


class Format(ctypes.Structure):
    """struct v4l2_format."""

    _fields_ = (("type", _u32), ("fmt", _AnyFormat))


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm with the capture branch of its union of 200 bytes, struct v4l2_captureparm."""

    _fields_ = (*_u32s("type capability mode"), ("timeperframe", Fraction), ("others", _u32 * 46))


class BufferRequest(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = _u32s("count type memory capabilities flags")


class _Timeval(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_usec", ctypes.c_long))


class _BufferMemory(ctypes.Union):
    _fields_ = (("offset", _u32), ("userptr", ctypes.c_long))


class V4l2Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _begin: ClassVar[_Fields] = [*_u32s("index type bytesused flags field"), ("timestamp", _Timeval)]
    _timecode: ClassVar[_Fields] = [("timecode", _u32 * 4), *_u32s("sequence memory")]
    _fields_ = (*_begin, *_timecode, ("m", _BufferMemory), *_u32s("length reserved request_fd"))

    @property
    def stamp_ns(self) -> int:
        """The kernel's stamp [ns]; the flags name its clock."""
        return int(self.timestamp.tv_sec) * 10**9 + int(self.timestamp.tv_usec) * 1000


class QueryControl(ctypes.Structure):
    """struct v4l2_queryctrl."""

    _values: ClassVar[_Fields] = [(name, Int32) for name in ("minimum", "maximum", "step", "default_value")]
    _fields_ = (*_u32s("id type"), ("name", ctypes.c_char * 32), *_values, *_u32s("flags reserved1 reserved2"))


class V4l2Control(ctypes.Structure):
    """struct v4l2_control."""

    _fields_ = (("id", _u32), ("value", Int32))


# Number of a request, and its direction: the bits of _IOC_WRITE (1) and _IOC_READ (2).
_REQUESTS: Final = {
    "QUERYCAP": (0, 2), "S_FMT": (5, 3), "REQBUFS": (8, 3), "QUERYBUF": (9, 3), "QBUF": (15, 3), "DQBUF": (17, 3),
    "STREAMON": (18, 1), "G_PARM": (21, 3), "S_PARM": (22, 3), "G_CTRL": (27, 3), "S_CTRL": (28, 3),
    "QUERYCTRL": (36, 3),
}  # fmt: skip


def request_code(name: str, argument: ctypes.Structure | Int32) -> int:
    """Return the code of a request such as S_FMT: _IOC of asm-generic/ioctl.h for the type 'V'."""
    number, direction = _REQUESTS[name]
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


def call(fd: int, request: str, argument: ctypes.Structure | Int32) -> None:
    """Pass the argument to the driver, which writes its result into it; raise OSError with the driver's errno."""
    fcntl.ioctl(fd, request_code(request, argument), argument, True)


def fourcc(code: int) -> str:
    """Return the four letters of a pixel format, such as 'YUYV'."""
    return code.to_bytes(4, "little").decode("latin-1").rstrip()


def fourcc_code(letters: str) -> int:
    """Return the number of a pixel format given by its four letters."""
    return int.from_bytes(letters.ljust(4).encode("latin-1"), "little")
