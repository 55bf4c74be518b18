"""Seeded mutations of bytes: cuts, flips, runs, copies of other parts, and extreme numbers."""

from __future__ import annotations

import random
import struct
from typing import Final

MAX_CHANGES: Final = 6
EXTREMES: Final = (0, 1, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1)
TEXTS: Final = (b"nan", b"inf", b"-1", b"1e308", b"0", b"99999999999999999999", b"[" * 50, b"\xff\xfe", b"\n", b'"')


def mutated(rng: random.Random, data: bytes) -> bytes:
    """Return the data with one or more mutations."""
    for _ in range(rng.randint(1, MAX_CHANGES)):
        data = _mutated_once(rng, data)
    return data


def _mutated_once(rng: random.Random, data: bytes) -> bytes:
    if not data:
        return rng.randbytes(rng.randint(1, 8))
    at = rng.randrange(len(data))
    to = min(len(data), at + rng.choice((1, 4, 8, 64, 1024)))
    match rng.randrange(7):
        case 0:  # a bit
            return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
        case 1:  # noise
            return data[:at] + rng.randbytes(to - at) + data[to:]
        case 2:  # a part left out
            return data[:at] + data[to:]
        case 3:  # the end left out
            return data[:at]
        case 4:  # another part copied here
            other = rng.randrange(len(data))
            return data[:at] + data[other : other + to - at] + data[at:]
        case 5:  # an extreme number
            return data[:at] + struct.pack("<Q", rng.choice(EXTREMES))[: rng.choice((2, 4, 8))] + data[to:]
        case _:  # an extreme word
            return data[:at] + rng.choice(TEXTS) + data[to:]
