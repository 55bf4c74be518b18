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
from omnid.core.places.place_search import Expected, PlaceSearch
from omnid.core.places.recognition import Recognition
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

# Difference up to which two recognised keyframes agree about where the maps lie; by trial on development seeds.
SAME_M: Final = 0.5
SAME_RAD: Final = math.radians(5)  # The same of their headings; by trial on development seeds.
MIN_CONSISTENT: Final = 3  # keyframes that agree, because one or two may be mistaken
# Share of the recognised keyframes that agree, because most are right where the maps have a place in common.
MIN_SHARE: Final = 0.6
# Keyframes, spread over the other map, that agree before the rest are searched near their places only, which costs a
# tenth of a search among all, because where 0.35 of the map lies there, so many agree with the share above in 1 % of
# the maps.
ENOUGH_CONSISTENT: Final = 16
# So that steps of this part of a turn leave no large gap, however many there are.
GOLDEN_RATIO: Final = (math.sqrt(5) - 1) / 2
NO_COMMON_PLACE: Final = "shares no place"  # words of the error, by which programs that join many maps know it


def merge(places: PlaceMap, other: PlaceMap, model: StereoModel) -> int:
    """Add another map to a map; return the number of keyframes that were recognised, 0 where the maps share no place.

    The frame of `places` stays. Its bounds are not applied; without a common place it stays as it is.
    Raises ValueError where a tag has another size in the other map.
    """
    places.tags.require_same_sizes(other.tags)
    renumbered = _renumbered(other, places)
    search, ids = PlaceSearch(model), sorted(places.keyframes)
    others = _evenly_spread(sorted(renumbered.keyframes))
    # 1. Recognise keyframes of the other map until enough agree; each recognition gives the pose of that map.
    loops, located = list[Link](), list[Array]()
    consistent, best = list[list[int]](), list[int]()
    while others and len(best) < max(ENOUGH_CONSISTENT, MIN_SHARE * len(located)):
        keyframe = renumbered.keyframes[others.pop(0)]
        found = search.far(keyframe.thumbnail, keyframe.features.loaded(), places, ids)
        if found is not None:
            loops.append(_loop(found, keyframe.id))
            located.append(_located(loops[-1], places, renumbered))
            same = [n for n, T in enumerate(located) if _is_same(T, located[-1])]
            for n in same[:-1]:
                consistent[n].append(same[-1])
            consistent.append(same)
            best = max(consistent, key=len)
    if len(best) < max(MIN_CONSISTENT, MIN_SHARE * len(located)):
        return 0
    T_map_other = located[best[len(best) // 2]]
    # 2. Recognise the other keyframes near the pose that the nearest of those before gives.
    loops, located = [loops[n] for n in best], [located[n] for n in best]
    error_m, error_rad = dict.fromkeys(ids, SAME_M), dict.fromkeys(ids, SAME_RAD)
    for id in sorted(others):
        keyframe, T = renumbered.keyframes[id], renumbered.poses[id]
        apart_m = np.linalg.norm(renumbered.positions([loop.b for loop in loops]) - T[:3, 3], axis=1)
        expected = Expected(located[int(apart_m.argmin())] @ T, error_m, error_rad, recognised=True)
        found = search.near(keyframe.thumbnail, keyframe.features.loaded(), places, expected)
        if found is not None:
            loops.append(_loop(found, id))
            located.append(_located(loops[-1], places, renumbered))
    # 3. Lay the other map there, and optimise both with the loops between them.
    places.keyframes |= renumbered.keyframes
    places.poses |= {id: T_map_other @ T for id, T in renumbered.poses.items()}
    places.links += renumbered.links
    places.uses |= renumbered.uses
    places.tags.join(renumbered.tags, int)
    places.dropped += renumbered.dropped
    MapCorrection(places).close(sorted(loops, key=lambda loop: loop.b), sorted(places.keyframes))
    return len(loops)


def _evenly_spread(ids: list[int]) -> list[int]:
    """Return ids in an order whose first ones, however many, are evenly spread over all (golden ratio sequence)."""
    return [ids[n] for n in sorted(range(len(ids)), key=lambda n: n * GOLDEN_RATIO % 1)]


def _loop(found: Recognition, id: int) -> Link:
    """Return the loop to a keyframe (id) of the other map that was recognised."""
    return Link(found.id, id, found.T_place_rect, found.covariance, found.inliers)


def _located(loop: Link, places: PlaceMap, other: PlaceMap) -> Array:
    """Return the pose of the other map that a loop to one of its keyframes gives."""
    return np.asarray(places.poses[loop.a] @ loop.T_a_b @ se3.inverse(other.poses[loop.b]))


def _renumbered(other: PlaceMap, places: PlaceMap) -> PlaceMap:
    """Return a map whose ids and sessions follow those of `places`."""
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
