"""Search of a frame among the keyframes of a map: a shortlist by signatures and votes, geometry, doubt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.features import FEATURES
from omnid.core.places.place_map import PlaceFeatures, PlaceKeyframe, PlaceMap
from omnid.core.places.recognition import Recognition, angle_rad, compare, length_m, supported, unambiguous
from omnid.core.places.signature import Signature, signature_of, similarities
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

# Set by trial on development seeds, where a line gives no other reason.
NEAR_M: Final = 1.5  # Keyframes within this distance of the pose by odometry are searched.
ENOUGH_INLIERS: Final = 50  # Inliers of a place with which the search ends.


class Effort(NamedTuple):
    """Numbers of keyframes in the steps of a search: fewer at each step, as each step costs more."""

    voted: int  # number of the most similar signatures, whose features vote
    compared: int  # number of those with most votes, which are compared


NEAR_EFFORT: Final = Effort(16, 3)  # Effort where the pose is known roughly by odometry; by trial on development seeds.
FAR_EFFORT: Final = Effort(200, 8)  # Effort where it is not; by trial on development seeds.


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Pose in the map that odometry expects for the frame, and its largest errors relative to each keyframe."""

    T_map_rect: Array  # (4, 4)
    error_m: Mapping[int, float]  # error by keyframe; a keyframe without an entry is not searched
    error_rad: Mapping[int, float]
    recognised: bool  # places were recognised lately: one that fits well is enough


class PlaceSearch:
    """Finds frames among keyframes, and counts what it refuses."""

    def __init__(self, model: StereoModel) -> None:
        self._model = model
        self._signatures: dict[int, Signature] = {}
        self.ambiguous = 0  # frames that fit two places equally well
        self.refused = 0  # recognitions that odometry contradicts
        self.contradicted = 0  # the newest of them, without one that odometry confirms in between
        self.compared: dict[int, int] = {}  # inliers of each keyframe that the last search compared

    def near(
        self, small: NDArray[np.int8], features: PlaceFeatures, places: PlaceMap, expected: Expected
    ) -> Recognition | None:
        """Return the best recognition among keyframes near the expected pose that odometry does not contradict."""
        known = list(expected.error_m)
        apart_m = np.linalg.norm(places.positions(known) - expected.T_map_rect[:3, 3], axis=1)
        near = apart_m < NEAR_M + np.array(list(expected.error_m.values()))
        ids = [known[n] for n in np.flatnonzero(near).tolist()]
        enough = ENOUGH_INLIERS if expected.recognised else FEATURES + 1
        found = supported(self._compare(small, features, places, ids, NEAR_EFFORT, enough), near=True)
        best = self._unambiguous(found, places.poses)
        if best is not None and not _is_expected(best, places.poses, expected):
            self.refused += 1
            self.contradicted += 1
            return None
        if best is not None:
            self.contradicted = 0
        return best

    def far(
        self, small: NDArray[np.int8], features: PlaceFeatures, places: PlaceMap, ids: list[int]
    ) -> Recognition | None:
        """Return the best recognition among keyframes (ids) of which odometry does not know where they are."""
        found = supported(self._compare(small, features, places, ids, FAR_EFFORT, FEATURES + 1))
        return self._unambiguous(found, places.poses)

    def _compare(
        self,
        small: NDArray[np.int8],
        features: PlaceFeatures,
        places: PlaceMap,
        ids: list[int],
        effort: Effort,
        enough: int,
    ) -> list[Recognition]:
        """Return the recognitions among the keyframes of a map (ids); it ends at one with enough inliers."""
        self.compared = {}
        if not ids:
            return []
        # The most similar signatures.
        others = np.array([self._signature(places.keyframes[id]) for id in ids])
        similar = similarities(signature_of(small), others)
        shortlist = [ids[n] for n in np.argsort(-similar, kind="stable")[: effort.voted].tolist()]
        known = {id: places.keyframes[id].features for id in shortlist}
        found = compare(features, known, places.poses, effort.compared, enough, self._model)
        self.compared = {id: 0 if place is None else place.inliers for id, place in found.items()}
        return [place for place in found.values() if place is not None]

    def _signature(self, keyframe: PlaceKeyframe) -> Signature:
        if keyframe.id not in self._signatures:
            self._signatures[keyframe.id] = signature_of(keyframe.thumbnail)
        return self._signatures[keyframe.id]

    def forget(self, places: PlaceMap) -> None:
        """Forget the signatures of keyframes that the map does not hold any more."""
        self._signatures = {id: found for id, found in self._signatures.items() if id in places.keyframes}

    def _unambiguous(self, found: list[Recognition], poses: Mapping[int, Array]) -> Recognition | None:
        """Return the recognition with most inliers, None where another place has nearly as many."""
        best = unambiguous(found, poses)
        self.ambiguous += best is None and bool(found)
        return best


def _is_expected(place: Recognition, poses: Mapping[int, Array], expected: Expected) -> bool:
    """True if a recognition is within the largest error of odometry."""
    difference = se3.inverse(expected.T_map_rect) @ poses[place.id] @ place.T_place_rect
    return length_m(difference) < expected.error_m[place.id] and angle_rad(difference) < expected.error_rad[place.id]
