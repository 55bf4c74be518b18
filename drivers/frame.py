"""One undecoded image of one camera, and its conversion to grey pixels."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import cv2
import numpy as np
import simplejpeg  # type: ignore[import-untyped]
from numpy.typing import NDArray

from drivers.errors import FrameDecodeError, one_line
from drivers.jpeg import Steps, quantisation_steps

Camera = Literal["lower", "upper"]
CAMERAS: tuple[Camera, Camera] = ("lower", "upper")

MAX_PIXELS = 64 * 2**20
_START_MARKER = {"jpeg": b"\xff\xd8\xff", "png": b"\x89PNG\r\n\x1a\n"}  # ITU T.81, B.1.1.3; PNG 1.2, 3.1
_JPEG_CHANNELS = {"Gray": 1, "YCbCr": 3, "RGB": 3}
# Some webcams write zeros before the end of image, which libjpeg reports as a fault. A zero after 0xFF is none of them.
_ZEROS_BEFORE_END = re.compile(rb"(?<!\xff)\0+(?=\xff\xd9)")
_EXTRANEOUS_AT_END = "extraneous bytes before marker 0xd9"
_PNG_END = b"IEND\xaeB`\x82"
# In the chunk IHDR, behind the signature, its length and name: width, height, bit depth, colour type (PNG 1.2, 4.1.1).
_PNG_START = struct.Struct(">16xIIxB")
_PNG_GREY = 0  # colour type
# Conversions by encoding without the number of bits, which are 8 or 16 a sample.
_TO_GRAY = {
    "bgr": cv2.COLOR_BGR2GRAY,
    "rgb": cv2.COLOR_RGB2GRAY,
    "bgra": cv2.COLOR_BGRA2GRAY,
    "rgba": cv2.COLOR_RGBA2GRAY,
    "bayer_rggb": cv2.COLOR_BayerRGGB2GRAY,
    "bayer_bggr": cv2.COLOR_BayerBGGR2GRAY,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2GRAY,
    "bayer_grbg": cv2.COLOR_BayerGRBG2GRAY,
}
_DEEP = "16"  # ends the names of encodings of 16 bits a sample
# The names are those of sensor_msgs/image_encodings.hpp; of nv12, nv21 and nv24 the plane of luma comes first.
_CHANNELS = dict.fromkeys(("mono8", "mono16", "nv12", "nv21", "nv24"), 1) | {"yuyv": 2, "uyvy": 2}
_CHANNELS |= {f"{name}{bits}": 1 if "bayer" in name else len(name) for name in _TO_GRAY for bits in (8, 16)}
_LUMA = {"yuyv": 0, "uyvy": 1}  # index of the luma byte of the two bytes of a pixel


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """An undecoded image; width, height, step and bigendian are used by the raw encodings only."""

    seq: int  # number of the frame of this camera, from 0
    stamp_ns: int  # capture time
    camera: Camera
    encoding: str  # jpeg | png | mono8 | mono16 | bgr8 | bayer_rggb8 | yuyv | uyvy | nv12 ...: see gray()
    data: memoryview | bytes | NDArray[Any]  # C-contiguous
    width: int = 0  # px
    height: int = 0  # px
    step: int = 0  # bytes from row to row; 0: rows without padding
    bigendian: bool = False  # byte order of samples of 16 bits
    bits: int = 16  # of the camera, 8, 10, 12 or 16: of these, images of 16 bits a sample show the upper eight
    bayer: str = ""  # encoding such as bayer_rggb8 of what was compressed: a jpeg or png of one channel is a pattern


class FrameSource(Protocol):
    """A source of frames: a camera, a log, a simulation."""

    def frames(self) -> Iterator[Frame]:
        """Yield the frames until the source ends or is closed."""

    def close(self) -> None:
        """Release the device or file; may be called twice."""


def gray(frame: Frame) -> NDArray[np.uint8]:
    """Return the image as (H, W) uint8, C-contiguous and read-only; it never aliases a writable buffer.

    Colours are converted with OpenCV's weights, Bayer patterns are interpolated before; of YUV the luma is kept.
    An EXIF orientation is ignored, since the calibration belongs to the sensor's own axes. Raises FrameDecodeError for
    an image that is truncated, malformed or of an unknown encoding, and for a JPEG of which libjpeg notices that a part
    was lost: with restart markers nearly any, without them what leaves the rest of the image undecodable.
    """
    try:
        data = np.frombuffer(frame.data, np.uint8)
        marker = _START_MARKER.get(frame.encoding, b"")
        head = data[: len(marker)].tobytes()
        if head != marker or not data.size:
            raise ValueError(f"it starts with {head.hex() or 'nothing'}")
        image = {"jpeg": _of_jpeg, "png": _of_png}.get(frame.encoding, _of_raw)(frame, data)
    except (cv2.error, ValueError, TypeError, BufferError, OverflowError, MemoryError) as error:
        raise FrameDecodeError(
            f"{frame.camera} frame {frame.seq} ({frame.encoding[:40]!r}) cannot be decoded: {one_line(error)}"
        ) from error
    image.setflags(write=False)
    return image


def coding_steps(frame: Frame) -> Steps:
    """Return the steps of a JPEG's quantisation, in zigzag order, () of another image."""
    return quantisation_steps(np.frombuffer(frame.data, np.uint8).data) if frame.encoding == "jpeg" else ()


def upper_eight_bits(samples: NDArray[Any], bits: int) -> NDArray[np.uint8]:
    """Return the upper eight of so many bits of each sample (H, W) uint16; larger samples become 255."""
    return np.asarray(np.minimum(samples >> (bits - 8), 255), np.uint8)


# Each returns the grey image (H, W), and raises ValueError with the reason before anything large is allocated.


def _of_jpeg(frame: Frame, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width, colours, _ = simplejpeg.decode_jpeg_header(data)
    _require_samples(width, height, _JPEG_CHANNELS.get(colours, 4))
    try:
        image = simplejpeg.decode_jpeg(data, "GRAY")
    except ValueError as error:
        if _EXTRANEOUS_AT_END not in str(error):
            raise
        image = simplejpeg.decode_jpeg(_ZEROS_BEFORE_END.sub(b"", data.tobytes()), "GRAY")
    return _interpolated(frame, frame.bayer if colours == "Gray" else "", image[..., 0])


def _of_png(frame: Frame, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    raw = data.tobytes()
    if raw.rfind(_PNG_END) < 0:
        raise ValueError(f"its end is missing after {data.size} bytes")
    width, height, colours = _PNG_START.unpack_from(raw.ljust(_PNG_START.size, b"\0"))
    _require_samples(width, height, 1 if colours == _PNG_GREY else 4)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH)
    if image is None or image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ValueError("its content is corrupt")
    return _interpolated(frame, frame.bayer if colours == _PNG_GREY else "", image)


def _of_raw(frame: Frame, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Use the pixels without the padding of rows and without further planes."""
    channels = _CHANNELS.get(frame.encoding)
    if channels is None:
        raise ValueError(f"known encodings are {', '.join([*_START_MARKER, *_CHANNELS])}")
    _require_samples(frame.width, frame.height, 1)
    dtype = np.dtype((">u2" if frame.bigendian else "<u2") if frame.encoding.endswith(_DEEP) else "u1")
    pixel_bytes = channels * dtype.itemsize
    row_bytes = frame.width * pixel_bytes
    step = frame.step or row_bytes
    if step < row_bytes:
        raise ValueError(f"its step is {step} bytes, a row of {frame.width} px takes {row_bytes}")
    if data.size < step * (frame.height - 1) + row_bytes:
        raise ValueError(f"it has {data.size} bytes, {frame.width} x {frame.height} px take {step * frame.height}")
    shape, strides = (frame.height, frame.width, channels), (step, pixel_bytes, dtype.itemsize)
    pixels: NDArray[Any] = np.ndarray(shape, dtype, buffer=data.data, strides=strides)
    if channels == 1 or frame.encoding in _LUMA:
        pixels = pixels[..., _LUMA.get(frame.encoding, 0)]
    image = _interpolated(frame, frame.encoding, pixels)
    return image.copy() if pixels.flags.writeable and np.may_share_memory(image, pixels) else image


def _interpolated(frame: Frame, encoding: str, samples: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the grey image of samples, which are grey or, as the encoding says, colours or a Bayer pattern."""
    name = encoding.removesuffix(_DEEP).removesuffix("8")
    if name in _TO_GRAY:
        samples = cv2.cvtColor(np.ascontiguousarray(samples, samples.dtype.newbyteorder("=")), _TO_GRAY[name])
    if samples.dtype != np.uint8:
        samples = upper_eight_bits(samples, frame.bits)
    return np.ascontiguousarray(samples)


def _require_samples(width: int, height: int, channels: int) -> None:
    """Raise ValueError for an empty or excessive image; decoders of progressive ones store all samples at once."""
    if width < 1 or height < 1 or width * height * channels > MAX_PIXELS:
        raise ValueError(f"its size is {width} x {height} px of {channels} channels, not 1 to {MAX_PIXELS} in all")
