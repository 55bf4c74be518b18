"""Keyframes of a map that stay where they are: what depends on their poses is computed once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from omnid.core.places.place_map import PlaceMap

Array = NDArray[np.float64]


class FixedPlaces:
    """Ids of keyframes in ascending order, their poses (K, 4, 4) and range scans."""

    def __init__(self, places: PlaceMap, ids: Sequence[int]) -> None:
        self.ids = ids
        self.known = frozenset(ids)
        self.poses: Array = np.array([places.poses[id] for id in ids]).reshape(-1, 4, 4)
        self.scans = {id: places.keyframes[id].scan for id in ids}
        self.free_m = {id: places.keyframes[id].free_m for id in ids}

    def within(self, position: Array, reach_m: float) -> list[int]:
        """Return the keyframes up to a distance of a position (3,), ascending."""
        is_near = np.linalg.norm(self.poses[:, :3, 3] - position, axis=1) <= reach_m
        return [self.ids[row] for row in np.flatnonzero(is_near).tolist()]
