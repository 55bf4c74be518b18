"""Index of the keyframes of a large map: a code of 64 bits for each of their strongest features.

A code takes a sixteenth of a descriptor, so those of all keyframes stay in memory, and all of them are searched. What
is similar by thumbnails is no shortlist in a large map: of 20,000 keyframes more than 200 may look more alike.
"""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.places.code_kernels import TURN, count_votes
from omnid.core.places.place_features import DESCRIPTOR, PlaceFeatures

CODE_BITS: Final = 64  # Bits of a code, so that it is one number.
INDEXED: Final = 100  # Features of a keyframe that have codes; by trial on development seeds.
# The first step: features of the frame, features of each keyframe, and keyframes that go to the second step, in which
# VOTERS features of the frame vote for all codes, because of 20,000 the right one was among 211 on development seeds.
FEW_VOTERS, FEW_INDEXED, KEPT = 24, 64, 1000
VOTERS: Final = 64  # Features of the frame in the second step, as in place_comparison.py.


def codes_of(features: PlaceFeatures) -> NDArray[np.uint64]:
    """Return the codes (N,) of the strongest features: signs of sums of a descriptor's values with signs (Walsh).

    Bit i - 1 is set where the sum over j of (-1)^(number of common bits of i and j) d_j is positive, i = 1 to 64.
    """
    sums = features.descriptors[:INDEXED].astype(np.float32) @ _signs()
    return np.asarray(np.packbits(sums > 0, axis=1, bitorder="little").view("<u8"), np.uint64).reshape(-1)


def azimuths_of(features: PlaceFeatures, width: int) -> NDArray[np.uint8]:
    """Return the azimuths (N,) of the strongest features in TURN steps of a full turn of `width` columns."""
    steps = np.floor(features.views[:INDEXED, 0] % width * (TURN / width)) % TURN
    return np.asarray(steps, np.uint8)


@cache
def _signs() -> NDArray[np.float32]:
    """Return the signs (128, 64) of the sums."""
    common = np.arange(DESCRIPTOR)[:, None] & np.arange(1, CODE_BITS + 1)[None]
    odd = np.array([[int(value).bit_count() % 2 for value in row] for row in common])
    return np.asarray(1 - 2 * odd, np.float32)


class CodeIndex:
    """Codes and azimuths of the features of keyframes (K), one after the other."""

    def __init__(
        self, ids: NDArray[np.int64], counts: NDArray[np.int64], codes: NDArray[np.uint64], azimuths: NDArray[np.uint8]
    ) -> None:
        """counts (K,): codes of each keyframe; the ids (K,) ascend."""
        self._ids, self._codes, self._azimuths = ids, codes, azimuths
        self._starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def has(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return flags (N,) of the keyframes (ids) that are in the index."""
        return np.isin(ids, self._ids)

    @property
    def nbytes(self) -> int:
        """Memory of the index."""
        return self._ids.nbytes + self._starts.nbytes + self._codes.nbytes + self._azimuths.nbytes

    def ranked(self, here: PlaceFeatures, ids: NDArray[np.int64], width: int) -> list[int]:
        """Return those of some keyframes (ids) that a frame may show, at most KEPT, those with most votes first."""
        rows = np.flatnonzero(np.isin(self._ids, ids))
        codes, azimuths = codes_of(here), azimuths_of(here, width)
        for voters, indexed in ((FEW_VOTERS, FEW_INDEXED), (VOTERS, INDEXED)):
            votes = np.zeros(len(rows), np.int32)
            count_votes(
                self._codes, self._azimuths, self._starts, rows, codes[:voters], azimuths[:voters], indexed, votes
            )
            rows = rows[np.argsort(-votes, kind="stable")[:KEPT]]
        return [int(id) for id in self._ids[rows]]
