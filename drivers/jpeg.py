"""Steps of a JPEG's quantisation, read from its header, and the noise that they cause. References are to ITU T.81."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np

_MAX_SEGMENTS: Final = 1000
_FILL: Final = 0xFF
_TABLES, _SCAN = 0xDB, 0xDA  # markers DQT: quantisation tables; SOS: the header ends here (table B.1)
_BLOCK_PX: Final = 8
_COEFFICIENTS: Final = _BLOCK_PX * _BLOCK_PX
# Diagonal by diagonal, in turn up and down (figure A.6): row and column of each coefficient of a table.
_ZIGZAG: Final = sorted(
    np.ndindex(_BLOCK_PX, _BLOCK_PX), key=lambda at: (sum(at), at[1] if sum(at) % 2 == 0 else at[0])
)

Steps: TypeAlias = tuple[int, ...]


def quantisation_steps(data: memoryview) -> Steps:
    """Return the steps of the 64 coefficients of luma, in zigzag order, of table 0; () where they are not found."""
    steps: Steps = ()
    offset = 2  # after the start of image
    for _ in range(_MAX_SEGMENTS):
        if data[offset : offset + 1] != bytes((_FILL,)) or offset + 4 > len(data):
            break
        marker, length = data[offset + 1], int.from_bytes(data[offset + 2 : offset + 4], "big")
        if marker == _SCAN:
            return steps
        if marker == _TABLES:
            steps = _tables(bytes(data[offset + 4 : offset + 2 + length])).get(0, steps)
        offset += 1 if marker == _FILL else 2 + length
    return ()


@lru_cache(maxsize=16)
def coding_sigma(steps: Steps, highest: int) -> float:
    """Return the standard deviation [grey levels] of the error of quantisation in the lowest frequencies of blocks.

    steps: as of `quantisation_steps`, (): 0. highest: the first of a block's 8 frequencies along rows and columns that
    does not count. An error is uniform within a step, so its variance is a twelfth of the square of the step. The
    transform is orthonormal (A.3.3), so the variance of a pixel is a 64th of the sum of these variances. The mean grey
    of a block does not count: it varies little within a window of some blocks. Contrast below a step is lost; its error
    is the contrast itself.
    """
    if not steps:
        return 0.0
    counted = [step for step, (i, j) in zip(steps, _ZIGZAG, strict=True) if i + j > 0 and max(i, j) < highest]
    return math.sqrt(sum(step * step for step in counted) / (12 * _COEFFICIENTS))


@lru_cache(maxsize=16)
def _tables(segment: bytes) -> Mapping[int, Steps]:
    """Return the whole tables of a segment by their numbers (B.2.4.1); each has steps of 8 or of 16 bits.

    A camera sends the same segments with each image.
    """
    found: dict[int, Steps] = {}
    while segment:
        number, kind = segment[0] & 15, np.dtype(">u2" if segment[0] >> 4 else "u1")
        size = 1 + kind.itemsize * _COEFFICIENTS
        if len(segment) < size:
            break
        found[number] = tuple(np.frombuffer(segment[1:size], kind).tolist())
        segment = segment[size:]
    return found
