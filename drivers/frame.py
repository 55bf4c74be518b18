"""One image of one camera as it came off the wire, and its grey pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import BrokenFrame

Camera = Literal["lower", "upper"]

MAX_PIXELS = 64 * 2**20
_MAX_JPEG_SEGMENTS = 1000
_PADDING_BYTES = 4096
_OPENING = {"jpeg": b"\xff\xd8\xff", "png": b"\x89PNG\r\n\x1a\n"}
_CLOSING = {"jpeg": b"\xff\xd9", "png": b"IEND\xaeB`\x82"}
_CHANNELS = {"mono8": 1, "mono16": 1, "bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4, "yuyv": 2, "uyvy": 2, "nv12": 1}
_LUMA = {"yuyv": 0, "uyvy": 1}  # the channel, of two bytes a pixel
_TO_GRAY = {
    "bgr8": cv2.COLOR_BGR2GRAY,
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
}


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """An undecoded image; width, height, step and bigendian describe the raw encodings only."""

    seq: int  # counts the frames of this camera from 0
    stamp_ns: int  # capture time
    camera: Camera
    encoding: str  # jpeg | png | mono8 | mono16 | bgr8 | rgb8 | bgra8 | rgba8 | yuyv | uyvy | nv12
    data: memoryview | bytes | NDArray[Any]  # C-contiguous
    width: int = 0  # px
    height: int = 0  # px
    step: int = 0  # bytes from row to row; 0: rows are packed
    bigendian: bool = False  # byte order of mono16


class FrameSource(Protocol):
    """Whatever delivers frames: a camera, a log, a simulation."""

    def frames(self) -> Iterator[Frame]:
        """Gives the frames until the source ends or is closed."""

    def close(self) -> None:
        """Lets go of the device or file; may be called twice."""


def gray(frame: Frame) -> NDArray[np.uint8]:
    """The image as (H, W) uint8, C-contiguous and read-only; it never aliases a writable buffer.

    Colours are weighed as OpenCV does, mono16 keeps its upper byte, yuyv, uyvy and nv12 their luma as it is, and an
    EXIF orientation is ignored, since the calibration belongs to the sensor's own axes. Raises BrokenFrame for
    anything cut, malformed or unknown.
    """
    try:
        image = _decompress(frame) if frame.encoding in _OPENING else _unpack(frame)
    except (cv2.error, ValueError, TypeError, BufferError, OverflowError, MemoryError) as error:
        raise _broken(frame, " ".join(str(error).split())[:120]) from error
    image.setflags(write=False)
    return image


def _broken(frame: Frame, reason: str) -> BrokenFrame:
    return BrokenFrame(f"{frame.camera} frame {frame.seq} ({frame.encoding[:40]!r}) cannot be decoded: {reason}")


def _decompress(frame: Frame) -> NDArray[np.uint8]:
    data = np.frombuffer(frame.data, np.uint8)
    head = data[: len(_OPENING[frame.encoding])].tobytes()
    if head != _OPENING[frame.encoding]:
        raise _broken(frame, f"it starts with {head.hex() or 'nothing'}")
    # libjpeg fills the missing rest of a cut image with grey and calls it a success, so the end is looked for first
    if not _unpadded_tail(data).endswith(_CLOSING[frame.encoding]):
        raise _broken(frame, f"its end is missing after {data.size} bytes")
    _refuse_size(frame, *(_png_size(data) if frame.encoding == "png" else _jpeg_size(data)))
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or image.ndim != 2 or image.dtype != np.uint8:
        raise _broken(frame, "its content is corrupt")
    return np.ascontiguousarray(image, np.uint8)


def _unpadded_tail(data: NDArray[np.uint8]) -> bytes:
    """The last bytes before any padding with zeros, which cameras add to fill their buffers."""
    end = data.size
    while end:
        tail = data[max(0, end - _PADDING_BYTES) : end].tobytes()
        if kept := len(tail.rstrip(b"\0")):
            return data[max(0, end - len(tail) + kept - 16) : end - len(tail) + kept].tobytes()
        end -= len(tail)
    return b""


def _png_size(data: NDArray[np.uint8]) -> tuple[int, int]:
    head = data[16:24].tobytes()
    return int.from_bytes(head[:4], "big"), int.from_bytes(head[4:], "big")


def _jpeg_size(data: NDArray[np.uint8]) -> tuple[int, int]:
    """(width, height) from the start-of-frame segment, (0, 0) where there is none (ITU T.81, B.1)."""
    at = 2
    for _ in range(_MAX_JPEG_SEGMENTS):
        segment = data[at : at + 9].tobytes()
        if len(segment) < 9 or segment[0] != 0xFF:
            break
        marker = segment[1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(segment[7:9], "big"), int.from_bytes(segment[5:7], "big")
        at += 1 if marker == 0xFF else 2 + int.from_bytes(segment[2:4], "big")
    return 0, 0


def _refuse_size(frame: Frame, width: int, height: int) -> None:
    """Raises BrokenFrame for a size that is empty or absurd, before anything of that size is allocated."""
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise _broken(frame, f"its size is {width} x {height} px, not 1 to {MAX_PIXELS} px in all")


def _unpack(frame: Frame) -> NDArray[np.uint8]:
    pixels = _pixels(frame)
    if frame.encoding in _LUMA:
        return np.array(pixels[..., _LUMA[frame.encoding]], np.uint8, order="C")
    if _CHANNELS[frame.encoding] == 1 and pixels.dtype == np.uint8:
        return np.array(pixels, np.uint8, order="C") if pixels.flags.writeable else np.ascontiguousarray(pixels)
    if frame.encoding == "mono16":
        return (pixels >> 8).astype(np.uint8)
    return np.ascontiguousarray(cv2.cvtColor(np.ascontiguousarray(pixels), _TO_GRAY[frame.encoding]), np.uint8)


def _pixels(frame: Frame) -> NDArray[Any]:
    """A view of the raw pixels, (H, W) or (H, W, channels), that leaves out the padding of the rows and the planes
    after the first."""
    channels = _CHANNELS.get(frame.encoding)
    if channels is None:
        raise _broken(frame, f"known encodings are {', '.join([*_OPENING, *_CHANNELS])}")
    _refuse_size(frame, frame.width, frame.height)
    dtype = np.dtype(np.uint8 if frame.encoding != "mono16" else ">u2" if frame.bigendian else "<u2")
    pixel = channels * dtype.itemsize
    row = frame.width * pixel
    step = frame.step or row
    data = np.frombuffer(frame.data, np.uint8)
    if step < row:
        raise _broken(frame, f"its step is {step} bytes, a row of {frame.width} px takes {row}")
    if data.size < step * (frame.height - 1) + row:
        raise _broken(frame, f"it has {data.size} bytes, {frame.width} x {frame.height} px take {step * frame.height}")
    shape, strides = (frame.height, frame.width, channels), (step, pixel, dtype.itemsize)
    axes = 2 if channels == 1 else 3
    return np.ndarray(shape[:axes], dtype, buffer=data.data, strides=strides[:axes])
