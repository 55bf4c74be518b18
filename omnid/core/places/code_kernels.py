"""Compiled part of the votes by codes of features: see code_index.py."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Codes = NDArray[np.uint64]
Bytes = NDArray[np.uint8]

TURN = 256  # Azimuths of a full turn, so that one is a byte.
BINS = 24  # Bins of the turn between two frames, as in place_comparison.py; three neighbours count together.
# Largest bits between two codes, as a share of those to the second best one, in tenths; by trial on development seeds.
RATIO_TENTHS, TENTHS = 8, 10
FAR = np.uint8(255)  # A distance that is none, so that it is more than the 64 bits of a code.
# Sums of bits in pairs, fours and eights (Warren 2012, Hacker's Delight, 5-1): exact for all 64 bits.
PAIRS, FOURS, EIGHTS = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333), np.uint64(0x0F0F0F0F0F0F0F0F)
BY_1, BY_2, BY_4, BY_8, BY_16, BY_32 = (np.uint64(1 << n) for n in range(6))
ALL_BITS = np.uint64(0x7F)  # Mask of the sum, so that it holds up to 64.


@compiled("(u8[::1], u1[::1], i8[::1], i8[::1], u8[::1], u1[::1], i8, i4[::1])", writes=("votes",))
def count_votes(
    codes: Codes,
    azimuths: Bytes,
    starts: NDArray[np.int64],
    rows: NDArray[np.int64],
    here: Codes,
    here_azimuths: Bytes,
    most: int,
    votes: NDArray[np.int32],
) -> None:
    """Write how many codes of a frame have a match, at one turn, among the first codes (`most`) of each keyframe.

    starts (K + 1,): of the codes of each keyframe; rows (R,): the keyframes that votes (R,) are for.
    """
    bins, bits = np.empty(BINS, np.int64), np.empty(most, np.uint8)
    for n in range(len(rows)):
        first = starts[rows[n]]
        count = min(starts[rows[n] + 1] - first, most)
        bins[:] = 0
        if count > 1:
            for k in range(len(here)):
                write_bits(codes[first : first + count], here[k], bits[:count])
                nearest = least(bits[:count])
                at = 0
                while bits[at] != nearest:
                    at += 1
                bits[at] = FAR
                if TENTHS * np.int64(nearest) < RATIO_TENTHS * np.int64(least(bits[:count])):
                    turned = (np.int64(here_azimuths[k]) - np.int64(azimuths[first + at])) % TURN
                    bins[turned * BINS // TURN] += 1
        most_votes = 0
        for b in range(BINS):
            most_votes = max(most_votes, bins[b] + bins[(b + 1) % BINS] + bins[(b + BINS - 1) % BINS])
        votes[n] = most_votes


@inner
def write_bits(codes: Codes, code: np.uint64, bits: Bytes) -> None:
    """Write in how many bits codes (N,) differ from one."""
    for n in range(len(codes)):
        x = codes[n] ^ code
        x = x - ((x >> BY_1) & PAIRS)
        x = (x & FOURS) + ((x >> BY_2) & FOURS)
        x = (x + (x >> BY_4)) & EIGHTS
        x = x + (x >> BY_8)
        x = x + (x >> BY_16)
        x = x + (x >> BY_32)
        bits[n] = np.uint8(x & ALL_BITS)


@inner
def least(values: Bytes) -> np.uint8:
    """Return the least of some values."""
    found = FAR
    for n in range(len(values)):
        found = values[n] if values[n] < found else found
    return found
