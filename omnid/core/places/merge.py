"""Merging of two maps of places of one rig: keyframes of one are recognised in the other, then both are optimised."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.correction import MapCorrection
from omnid.core.places.hypotheses import angle_rad, length_m
from omnid.core.places.place_map import Link, PlaceMap
from omnid.core.places.place_search import PlaceSearch
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

# Difference up to which two recognised keyframes agree about where the maps lie; by trial on development seeds.
SAME_M: Final = 0.5
SAME_RAD: Final = math.radians(5)  # The same of their headings; by trial on development seeds.
MIN_CONSISTENT: Final = 3  # keyframes that must agree
MIN_SHARE: Final = 0.6  # Share of the recognised keyframes that must agree.
NO_COMMON_PLACE: Final = "shares no place"  # words of the error, by which programs that join many maps know it


def merge(places: PlaceMap, other: PlaceMap, model: StereoModel) -> int:
    """Add another map to a map; return the number of keyframes that were recognised, 0 where the maps share no place.

    The frame of `places` stays. Its bounds are not applied; without a common place it stays as it is.
    Raises ValueError where a tag has another size in the other map.
    """
    places.tags.require_same_sizes(other.tags)
    renumbered = _renumbered(other, places)
    search, ids = PlaceSearch(model), sorted(places.keyframes)
    # 1. Recognise each keyframe of the other map; each recognition tells where the other map lies.
    loops, located = list[Link](), list[Array]()
    for id in sorted(renumbered.keyframes):
        keyframe = renumbered.keyframes[id]
        found = search.far(keyframe.thumbnail, keyframe.features.loaded(), places, ids)
        if found is not None:
            loops.append(Link(found.id, id, found.T_place_rect, found.covariance, found.inliers))
            located.append(places.poses[found.id] @ found.T_place_rect @ se3.inverse(renumbered.poses[id]))
    # 2. Most of them must agree.
    consistent = [[n for n, T in enumerate(located) if _is_same(T, first)] for first in located]
    best = max(consistent, key=len, default=[])
    if len(best) < max(MIN_CONSISTENT, MIN_SHARE * len(located)):
        return 0
    # 3. Lay the other map there, and optimise both with the loops between them.
    T_map_other = located[best[len(best) // 2]]
    places.keyframes |= renumbered.keyframes
    places.poses |= {id: T_map_other @ T for id, T in renumbered.poses.items()}
    places.links += renumbered.links
    places.uses |= renumbered.uses
    places.tags.join(renumbered.tags, int)
    places.dropped += renumbered.dropped
    MapCorrection(places).close([loops[n] for n in best], sorted(places.keyframes))
    return len(best)


def _renumbered(other: PlaceMap, places: PlaceMap) -> PlaceMap:
    """Return a map whose ids and sessions go on after those of `places`."""
    first_session = 1 + max((keyframe.session for keyframe in places.keyframes.values()), default=-1)
    new = {id: places.next_id + n for n, id in enumerate(sorted(other.keyframes))}
    found = PlaceMap()
    found.keyframes = {
        new[id]: replace(other.keyframes[id], id=new[id], session=first_session + other.keyframes[id].session)
        for id in new
    }
    found.poses = {new[id]: other.poses[id] for id in new}
    found.links = [replace(link, a=new[link.a], b=new[link.b]) for link in other.links]
    found.uses = {new[id]: use for id, use in other.uses.items()}
    found.tags.join(other.tags, new.__getitem__)
    found.dropped = other.dropped
    return found


def _is_same(a: Array, b: Array) -> bool:
    difference = se3.inverse(a) @ b
    return length_m(difference) < SAME_M and angle_rad(difference) < SAME_RAD
