"""Features of a place, in memory or in a file until a search needs them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

DESCRIPTOR: Final = 128  # Bytes of a descriptor; exact: 8 directions in 4 x 4 cells.


@dataclass(frozen=True, slots=True, eq=False)
class PlaceFeatures:
    """Features of a lower panorama whose depth is known: descriptors (N, 128), views (N, 3) [px].

    A view is column, lower row, upper row.
    """

    descriptors: NDArray[np.uint8]
    views: NDArray[np.float32]

    @property
    def count(self) -> int:
        """Number of the features."""
        return len(self.views)

    @property
    def nbytes(self) -> int:
        """Memory that the features take."""
        return self.descriptors.nbytes + self.views.nbytes

    def loaded(self) -> PlaceFeatures:
        """Return the features, which are in memory."""
        return self

    def copied(self) -> PlaceFeatures:
        """Return the features, to any thread."""
        return self

    def first(self, count: int) -> PlaceFeatures:
        """Return the first of the features: the strongest ones, which are evenly spread."""
        return PlaceFeatures(self.descriptors[:count], self.views[:count])


# Features of a frame that shows none; exact.
NOTHING: Final = PlaceFeatures(np.zeros((0, DESCRIPTOR), np.uint8), np.zeros((0, 3), np.float32))


class FeatureStore:
    """Features of keyframes in a file; those that were read last stay in memory, in bounded memory.

    What cannot be read counts as no features: such a keyframe is not recognised, and the others are.
    """

    def __init__(self, read: Callable[[int], PlaceFeatures | None], most_bytes: int) -> None:
        """read: returns the features of a keyframe (id), None where they are damaged."""
        self._read, self._most_bytes = read, most_bytes
        self._kept: dict[int, PlaceFeatures] = {}  # the one that was used last at the end
        self._shift_px = np.float32(0)
        self.nbytes = 0  # of those in memory
        self.reads = 0  # from the file
        self.unreadable = 0  # reads of damaged features

    def of(self, id: int) -> PlaceFeatures:
        """Return the features of a keyframe; they are kept for the next search. For one thread."""
        found = self._kept.pop(id, None)
        if found is None:
            found = self.read(id)
            self.nbytes += found.nbytes
        self._kept[id] = found
        while self.nbytes > self._most_bytes and len(self._kept) > 1:
            self.nbytes -= self._kept.pop(next(iter(self._kept))).nbytes
        return found

    def read(self, id: int) -> PlaceFeatures:
        """Read the features of a keyframe from the file; nothing is kept, so any thread may do it."""
        self.reads += 1
        found = self._read(id)
        if found is None:
            self.unreadable += 1
            return NOTHING
        if self._shift_px:
            found.views[:, 1:] += self._shift_px
        return found

    @property
    def counts(self) -> dict[str, int]:
        """Counters, for the status."""
        return {"features_read": self.reads, "features_unreadable": self.unreadable}

    def shift_rows(self, shift_px: float) -> None:
        """Shift the rows of all views: the horizon of the panoramas is elsewhere than in the file."""
        self._shift_px += np.float32(shift_px)
        self._kept, self.nbytes = {}, 0


@dataclass(frozen=True, slots=True, eq=False)
class StoredFeatures:
    """Features of a keyframe that are in a file until they are needed."""

    id: int  # of the keyframe in the file
    count: int
    store: FeatureStore

    @property
    def nbytes(self) -> int:
        """Memory of the features beside that of the store: none."""
        return 0

    def loaded(self) -> PlaceFeatures:
        """Return the features, read from the file where they are not in memory."""
        return self.store.of(self.id)

    def copied(self) -> PlaceFeatures:
        """Return the features, read from the file, to any thread."""
        return self.store.read(self.id)
