"""Size of a JPEG, steps of its quantisation and order of its restart markers, from its bytes, before it is decoded.

References are to ITU T.81. Cameras that send motion JPEG write a restart marker after about each row of blocks. Where
some were lost on the way, with the blocks between them, libjpeg continues at the next marker that it finds. Markers are
numbered modulo 8: if the number differs from the expected one, a part of the image becomes grey; if it happens to be
the same, all below the gap is shown higher up. libjpeg reports success in both cases.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

_MAX_SEGMENTS: Final = 1000
_FIRST_FRAME, _LAST_FRAME = 0xC0, 0xCF  # markers SOF0 to SOF15 (table B.1)
_NO_FRAME: Final = (0xC4, 0xC8, 0xCC)  # among them: DHT, JPG, DAC
_SEQUENTIAL: Final = (0xC0, 0xC1)  # SOF0 and SOF1: baseline and extended, with Huffman codes
_FILL: Final = 0xFF
_NO_LENGTH: Final = (0x00, 0x01, *range(0xD0, 0xDA))  # stuffed byte, TEM, RST0 to RST7, SOI, EOI: not in a header
_LENGTH_BYTES: Final = 2  # the length counts itself
_SCAN, _INTERVAL, _END = 0xDA, 0xDD, 0xD9  # SOS: the header ends here; DRI; EOI
_TABLES, _MOST_TABLES = 0xDB, 4  # DQT: quantisation tables, and how many there are at most (B.2.4.1)
_FIRST_RESTART, _RESTARTS = 0xD0, 8  # RST0 to RST7 follow each other in turn
_FRAME_BYTES: Final = 10  # marker, length, precision, height, width, number of components
_COMPONENT_BYTES: Final = 3  # identifier, sampling factors, quantisation table
_BLOCK_PX: Final = 8
_COEFFICIENTS: Final = _BLOCK_PX * _BLOCK_PX
# Diagonal by diagonal, in turn up and down (figure A.6): row and column of each coefficient of a table.
_ZIGZAG: Final = sorted(
    ((i, j) for i in range(_BLOCK_PX) for j in range(_BLOCK_PX)),
    key=lambda at: (at[0] + at[1], at[1] if (at[0] + at[1]) % 2 == 0 else at[0]),
)

Steps: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class JpegHeader:
    """Size and layout of an image."""

    width: int = 0  # px
    height: int = 0  # px
    channels: int = 0
    units: int = 0  # minimum coded units (A.2) of its one scan; 0: it may have several scans
    interval: int = 0  # units from restart marker to restart marker; 0: it has none
    scan: int = 0  # offset of the scan header
    steps: Steps = ()  # of the 64 coefficients of the first component, in zigzag order; (): not known


def read_header(data: NDArray[np.uint8]) -> JpegHeader:
    """Return the header of a JPEG (B.1.1 and B.2.2).

    All fields are zero where there is no frame header or more than one, or a marker without a length that libjpeg
    skips: the bytes after it are no length, and would lead to another frame header than libjpeg finds.
    """
    offset, interval = 2, 0  # after the start of image
    frames: list[int] = []
    tables: dict[int, Steps] = {}
    for _ in range(_MAX_SEGMENTS):
        segment = data[offset : offset + _FRAME_BYTES].tobytes()
        if len(segment) < _FRAME_BYTES or segment[0] != _FILL:
            break
        marker, length = segment[1], int.from_bytes(segment[2:4], "big")
        if marker == _SCAN:
            return _header(data, frames[0], interval, offset, tables) if len(frames) == 1 else JpegHeader()
        if marker in _NO_LENGTH or (marker != _FILL and length < _LENGTH_BYTES):
            break
        if _FIRST_FRAME <= marker <= _LAST_FRAME and marker not in _NO_FRAME:
            frames.append(offset)
        if marker == _INTERVAL:
            interval = int.from_bytes(segment[4:6], "big")
        if marker == _TABLES:
            tables.update(_quantisation(data[offset + 4 : offset + 2 + length].tobytes()))
        offset += 1 if marker == _FILL else 2 + length
    return JpegHeader()


def restart_fault(data: NDArray[np.uint8], header: JpegHeader) -> str:
    """Return what is wrong with the restart markers of an image, empty where nothing is (E.2.4)."""
    if not header.units:
        return ""
    # In the data of a scan 0xFF is followed by a stuffed zero, a fill byte or a marker (B.1.1.5).
    body = data[header.scan :]
    following = body[1:][body[:-1] == _FILL]
    end = np.flatnonzero(following == _END)
    numbers = following[: end[0] if len(end) else len(following)].astype(np.int64) - _FIRST_RESTART
    found = numbers[(numbers >= 0) & (numbers < _RESTARTS)]
    expected = (header.units - 1) // header.interval if header.interval else 0
    if len(found) != expected:
        return (
            f"{len(found)} of {expected} restart markers arrived: a part of it is lost, and the rest may be displaced"
        )
    if (found != np.arange(expected) % _RESTARTS).any():
        return "its restart markers are not in order: a part of it is lost, and the rest may be displaced"
    return ""


@lru_cache(maxsize=16)
def coding_sigma(steps: Steps, highest: int) -> float:
    """Return the standard deviation [grey levels] of what quantisation changes, of the lowest frequencies of blocks.

    steps: JpegHeader.steps, (): 0. highest: of a block's 8 frequencies along rows and columns, the first that does not
    count. An error is even within a step, so its variance is a twelfth of the step's square; the transform is
    orthonormal (A.3.3), so a pixel has a 64th of their sum. The mean grey of blocks, which varies little within a
    window of some blocks, does not count. Weaker contrast than a step is lost, with an error as large as itself.
    """
    if not steps:
        return 0.0
    counted = [step for step, (i, j) in zip(steps, _ZIGZAG, strict=True) if i + j > 0 and max(i, j) < highest]
    return math.sqrt(sum(step * step for step in counted) / (12 * _COEFFICIENTS))


@lru_cache(maxsize=16)
def _quantisation(segment: bytes) -> Mapping[int, Steps]:
    """Return the whole tables of a segment by their numbers; each has steps of 8 or of 16 bits.

    A camera sends the same segments with each image.
    """
    found: dict[int, Steps] = {}
    offset = 0
    while offset < len(segment) and len(found) < _MOST_TABLES:
        number, size = segment[offset] & 15, 2 if segment[offset] >> 4 else 1
        steps = segment[offset + 1 : offset + 1 + size * _COEFFICIENTS]
        if len(steps) < size * _COEFFICIENTS or number in found:
            break
        found[number] = tuple(int.from_bytes(steps[k : k + size], "big") for k in range(0, len(steps), size))
        offset += 1 + len(steps)
    return found


def _header(data: NDArray[np.uint8], frame: int, interval: int, scan: int, tables: Mapping[int, Steps]) -> JpegHeader:
    """Return the header whose frame header and scan header are at these offsets."""
    segment = data[frame : frame + _FRAME_BYTES].tobytes()
    height, width, channels = int.from_bytes(segment[5:7], "big"), int.from_bytes(segment[7:9], "big"), segment[9]
    start = frame + _FRAME_BYTES
    sampling = data[start + 1 : start + _COMPONENT_BYTES * channels : _COMPONENT_BYTES]
    # A scan with all components interleaves them in units of the largest sampling factors; with one, a unit is a block.
    units, (in_scan,) = 0, data[scan + 4 : scan + 5].tolist() or [0]
    if segment[1] in _SEQUENTIAL and channels == in_scan == len(sampling) and sampling.all():
        across, down = (1, 1) if channels == 1 else (int((sampling >> 4).max()), int((sampling & 15).max()))
        units = -(-width // (_BLOCK_PX * max(1, across))) * -(-height // (_BLOCK_PX * max(1, down)))
    (table,) = data[start + 2 : start + 3].tolist() or [-1]
    return JpegHeader(width, height, channels, units, interval, scan, tables.get(table, ()))
