"""Ageing of places: what changed is not recognised any more, visit after visit, and leaves the map.

The place itself stays in the map by newer keyframes: a keyframe is missed only where another one is recognised.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.places.place_map import UNUSED, KeyframeUse, PlaceMap

Array = NDArray[np.float64]

# Set by trial on development seeds, where a line gives no other reason.
BESIDE_M: Final = 0.3  # A keyframe this near to a frame shows the same view, if nothing has changed.
FOUND_INLIERS: Final = 20  # Inliers with which a keyframe counts as recognised.
VISIT_M: Final = 3.0  # Length of path between two visits of a place.
AGED_MISSES: Final = 3  # Consecutive visits at which a keyframe is missed, before the next one drops it.


class Ageing:
    """Counts for each keyframe of a map the visits at which it was found and missed.

    One that was found at many visits is kept as long: light may come back that one season takes away.
    """

    def __init__(self, places: PlaceMap) -> None:
        self._places = places
        self._counted: dict[int, tuple[float, bool]] = {}  # path at the last visit, and whether it was found at it
        self.aged = 0  # keyframes that left

    def observe(self, position: Array, inliers: Mapping[int, int], path_m: float) -> None:
        """Count the keyframes that were compared with a frame at a position (3,) in the map; drop those that aged.

        inliers: of each keyframe that was compared. path_m: of the run so far.
        """
        ids = [id for id in inliers if id in self._places.keyframes]
        beside = np.linalg.norm(self._places.positions(ids) - position, axis=1) < BESIDE_M
        for id, is_beside in zip(ids, beside.tolist(), strict=True):
            is_found = inliers[id] >= FOUND_INLIERS
            if is_found or is_beside:
                self._count(id, path_m, is_found=is_found)
        self._counted = {id: last for id, last in self._counted.items() if id in self._places.keyframes}

    def _count(self, id: int, path_m: float, *, is_found: bool) -> None:
        """Count a keyframe once a visit: as found where one frame of the visit finds it."""
        last_m, was_found = self._counted.get(id, (-np.inf, False))
        same_visit = path_m - last_m < VISIT_M
        self._counted[id] = path_m, is_found or (same_visit and was_found)
        use = self._places.uses.get(id, UNUSED)
        if is_found:
            self._places.uses[id] = KeyframeUse(use.found + (not (same_visit and was_found)), 0)
        elif not same_visit and use.missed >= max(AGED_MISSES, use.found):
            self._places.drop(id)
            self.aged += 1
        elif not same_visit:
            self._places.uses[id] = KeyframeUse(use.found, use.missed + 1)
