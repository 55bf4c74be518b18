"""Parts of a map: groups of keyframes whose poses are known relative to each other, but not to those of other parts.

A run that extends a saved map begins a part of its own, and so does odometry after a gap of unknown motion. A place
that is recognised in another part joins the two.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.place_map import PlaceMap

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
