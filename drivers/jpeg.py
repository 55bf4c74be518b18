"""Steps of a JPEG's quantisation, read from its header, and the noise that they cause. References are to ITU T.81."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Final, TypeAlias

_MAX_SEGMENTS: Final = 1000
_FILL: Final = 0xFF
_TABLES, _SCAN = 0xDB, 0xDA  # markers DQT: quantisation tables; SOS: the header ends here (table B.1)
_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 to SOF15, without DHT, JPG and DAC
_TABLE_OF_FIRST_COMPONENT: Final = 8  # offset in a frame header, after precision, size, number, identifier, sampling
_BLOCK_PX: Final = 8
_COEFFICIENTS: Final = _BLOCK_PX * _BLOCK_PX
# Diagonal by diagonal, in turn up and down (figure A.6): row and column of each coefficient of a table.
_ZIGZAG: Final = sorted(
    ((i, j) for i in range(_BLOCK_PX) for j in range(_BLOCK_PX)),
    key=lambda at: (at[0] + at[1], at[1] if (at[0] + at[1]) % 2 == 0 else at[0]),
)

Steps: TypeAlias = tuple[int, ...]


def quantisation_steps(data: memoryview) -> Steps:
    """Return the steps of the 64 coefficients of the first component, in zigzag order; () where they are not found."""
    tables: dict[int, Steps] = {}
    table, offset = -1, 2  # after the start of image
    for _ in range(_MAX_SEGMENTS):
        head = bytes(data[offset : offset + 4])
        if len(head) < 4 or head[0] != _FILL:
            break
        marker, length = head[1], int.from_bytes(head[2:], "big")
        segment = bytes(data[offset + 4 : offset + 2 + length])
        if marker == _SCAN:
            return tables.get(table, ())
        if marker == _TABLES:
            tables.update(_tables(segment))
        elif marker in _FRAMES and len(segment) > _TABLE_OF_FIRST_COMPONENT:
            table = segment[_TABLE_OF_FIRST_COMPONENT]
        offset += 1 if marker == _FILL else 2 + length
    return ()


@lru_cache(maxsize=16)
def coding_sigma(steps: Steps, highest: int) -> float:
    """Return the standard deviation [grey levels] of what quantisation changes, of the lowest frequencies of blocks.

    steps: as of `quantisation_steps`, (): 0. highest: of a block's 8 frequencies along rows and columns, the first that
    does not count. An error is even within a step, so its variance is a twelfth of the step's square; the transform is
    orthonormal (A.3.3), so a pixel has a 64th of their sum. The mean grey of blocks, which varies little within a
    window of some blocks, does not count. Weaker contrast than a step is lost, with an error as large as itself.
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
    offset = 0
    while offset < len(segment):
        number, size = segment[offset] & 15, 2 if segment[offset] >> 4 else 1
        steps = segment[offset + 1 : offset + 1 + size * _COEFFICIENTS]
        if len(steps) < size * _COEFFICIENTS:
            break
        found[number] = tuple(int.from_bytes(steps[k : k + size], "big") for k in range(0, len(steps), size))
        offset += 1 + len(steps)
    return found
