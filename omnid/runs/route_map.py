"""The map of places of a run, as the routes see it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.se2_arrays import planar
from omnid.core.navigation.route import KeyframePose
from omnid.stages.places import Places

MOST_NOTED: Final = 200  # keyframes that tell a map from others


class RunRouteMap:
    """The keyframes of the map; its methods may be called while the stage of the places works."""

    def __init__(self, places: Places, T_base_rig: NDArray[np.float64], name: str) -> None:
        """name: of the map's file; empty: it is not saved."""
        self.name, self.is_new = name, not places.keyframe_ids()
        self._places, self._T_base_rig, self._T_rig_base = places, T_base_rig, se3.inverse(T_base_rig)

    def keyframe(self, id: int) -> KeyframePose | None:
        """Return a keyframe as the map knows it now, None without one."""
        found = self._places.keyframe(id)
        if found is None:
            return None
        stamp_ns, T_map_rig = found
        return KeyframePose(stamp_ns, planar(self._T_base_rig @ T_map_rig @ self._T_rig_base))

    def noted(self) -> Mapping[int, int]:
        """Return stamps of some keyframes, evenly over the map."""
        ids = self._places.keyframe_ids()
        chosen = ids[:: max(1, len(ids) // MOST_NOTED)]
        found = {id: self._places.keyframe(id) for id in chosen}
        return {id: keyframe[0] for id, keyframe in found.items() if keyframe is not None}

    def save(self) -> None:
        """Ask for a copy of the map, which the run writes soon."""
        self._places.want_copy()
