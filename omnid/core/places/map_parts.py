"""Parts of a map that links connect, keyframes that are out of date, and keyframes that stay fixed.

A run that extends a saved map begins a part of its own, and so does odometry after a gap of unknown motion. A place
that is recognised in another part joins the two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.place_map import UNUSED, KeyframeUse, PlaceMap

Array = NDArray[np.float64]


class MapParts:
    """The part of each keyframe, and the part that grows now; parts have numbers, the oldest has the lowest."""

    def __init__(self, places: PlaceMap) -> None:
        """places: a map whose keyframes are one part; the keyframes of this run begin another part."""
        self._places = places
        self._part_of = dict.fromkeys(places.keyframes, 0)
        self.current = 1 if places.keyframes else 0

    def __len__(self) -> int:
        """Return the number of parts that have keyframes."""
        return len(set(self._part_of.values()))

    def number(self, id: int) -> int:
        """Return the number of the part of a keyframe."""
        return self._part_of[id]

    def add(self, id: int) -> None:
        """Add a keyframe to the current part."""
        self._part_of[id] = self.current

    def begin(self) -> None:
        """Begin a new part: the motion since the last keyframe is unknown."""
        self.current = 1 + max(self._part_of.values(), default=-1)

    def ids(self, part: int | None = None) -> list[int]:
        """Return the keyframes of a part in the order of their addition; None: those of the current part."""
        wanted = self.current if part is None else part
        return [id for id, number in self._part_of.items() if number == wanted]

    def others(self) -> list[int]:
        """Return the keyframes of all parts but the current one."""
        return [id for id, number in self._part_of.items() if number != self.current]

    def oldest(self) -> list[int]:
        """Return the keyframes of the part that has the oldest keyframe."""
        return self.ids(self._part_of.get(min(self._part_of, default=0), self.current))

    def join(self, other: int, T_other_current: Array) -> None:
        """Join the current part with another one, T_other_current (4, 4) apart; the older one stays where it is."""
        stays = min(other, self.current)
        moved = self.current if stays == other else other
        by = T_other_current if moved == self.current else se3.inverse(T_other_current)
        self._places.move({id: by @ self._places.poses[id] for id in self.ids(moved)})
        self._part_of = {id: stays if number == moved else number for id, number in self._part_of.items()}
        self.current = stays

    def forget_dropped(self) -> bool:
        """Forget the keyframes that are no longer in the map; True if there were any."""
        kept = self._places.keyframes
        if kept.keys() == self._part_of.keys():
            return False
        self._part_of = {id: number for id, number in self._part_of.items() if id in kept}
        return True


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
