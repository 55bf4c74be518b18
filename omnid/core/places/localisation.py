"""Localisation in a map: keep keyframes of odometry, recognise places, close loops, and give the pose of odom.

MapLocaliser.process is the algorithm, one frame at a time. Odometry stays as it is; T_map_odom carries the correction.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.scan_grid import KeyframeScans
from omnid.core.places.correction import MapCorrection
from omnid.core.places.drift import relative_covariance
from omnid.core.places.features import describe
from omnid.core.places.hypotheses import Hypotheses, Hypothesis, SearchSchedule
from omnid.core.places.map_parts import Ageing, FixedPlaces, MapParts
from omnid.core.places.map_pose import UNKNOWN_PLACE, MapPose, OdometryFrame
from omnid.core.places.place_map import (
    NO_KEYFRAME,
    NOTHING,
    PlaceFeatures,
    PlaceKeyframe,
    PlaceLimits,
    PlaceMap,
    by_odometry,
)
from omnid.core.places.place_search import NEAR_M, Expected, PlaceSearch
from omnid.core.places.recognition import MIN_MATCHES, Recognition, length_m
from omnid.core.places.signature import Thumbnail, thumbnail
from omnid.core.types.stereo_model import StereoModel
from omnid.tracking_state import MapState

Array = NDArray[np.float64]

LOCAL_M: Final = 3.0  # Loops closer along the path are ignored, because odometry itself still sees what is that near.
TIES: Final = 50  # newest keyframes kept besides a fixed map, so that memory is bounded
# Largest error of odometry, and its growth with the path; by trial on development seeds.
GATE_M, GATE_PER_M = 0.15, 0.05
GATE_RAD, GATE_RAD_PER_M = math.radians(3), math.radians(0.4)  # The same of the heading; by trial on development seeds.
# After so many contradictions in a row odometry has missed a motion, because right ones in worlds that repeat had 3.
CONTRADICTIONS: Final = 10
# A pose counts as localised up to this length of path after the last recognition.
RECENT_M: Final = 15.0


class MapLocaliser:
    """Holds the map, and the pose of odom in it."""

    def __init__(
        self, model: StereoModel, limits: PlaceLimits, places: PlaceMap | None = None, *, localize_only: bool = False
    ) -> None:
        """places: a map to be extended; None: a new one, which begins where odom does. localize_only: the map stays as
        it is; the newest keyframes of the run tie odom to it, and are no places.
        """
        self._limits = limits
        self.places = places if places is not None else PlaceMap()
        self._fixed = FixedPlaces(self.places, sorted(self.places.keyframes) if localize_only else [])
        self._localize_only = localize_only
        self.places.max_keyframes = len(self._fixed.ids) + TIES + 1 if localize_only else limits.max_keyframes
        # A map has the columns of full turns, whatever sector of them the cameras show.
        self.search = PlaceSearch(replace(model, cylinder=model.cylinder.full_turn))
        self.correction = MapCorrection(self.places)
        self.ageing = Ageing(self.places)
        self._session = 1 + max((k.session for k in self.places.keyframes.values()), default=-1)
        self._parts = MapParts(self.places)
        self._schedule = SearchSchedule(limits)
        self._hypotheses = Hypotheses()
        self._newest: PlaceKeyframe | None = None  # newest keyframe of this part, placed by odometry
        self._T_map_odom = np.eye(4)
        self._resets = 0
        self._path_m = self._confirmed_m = 0.0  # m: the path, and that at the last search before contradictions
        self._path_at: dict[int, float] = {}  # m, of the keyframes of this run
        self._recognised_at: tuple[float, Array] | None = None  # path and place of the last recognition that counted
        self._last_T: Array | None = None
        self._scans: tuple[object, KeyframeScans] | None = None  # what they depend on, and they

    def process(self, frame: OdometryFrame, *, idle: bool = False) -> MapPose:
        """Return the pose of odom in the map after a frame; idle: only by odometry, to save time."""
        self._advance(frame)
        if frame.lost:
            return self._pose(frame, MapState.LOST)
        if idle:
            return self._pose(frame, self._state())
        is_keyframe = self._schedule.keyframe_is_due(
            self._newest, frame.stamp_ns, frame.T_odom_rect, has_depth=frame.is_keyframe
        )
        if is_keyframe or self._search_is_due(frame):
            small, features = thumbnail(frame.stereo.lower), describe(frame.stereo)
            # 1. Recognise: a shortlist by signatures, matches, RANSAC, Gauss-Newton; not what is ambiguous.
            found = self._recognise(frame, small, features)
            # 2. Keep the keyframe, linked to the one before by odometry.
            if is_keyframe:
                self._add(frame, small, features)
            # 3. Correct the map where several frames agree; a full one may just have dropped the recognised keyframe.
            if found is not None and self._newest is not None and found.id in self.places.poses:
                self._close_loop(frame, found, self._newest)
                self._age(found)
        return self._pose(frame, self._state())

    @property
    def counts(self) -> dict[str, int]:
        """Sizes and counters, for the status."""
        return {
            "keyframes": len(self.places),
            "map_kb": self.places.nbytes // 1000,
            "loops": self.places.loops,
            "dropped": self.places.dropped,
            "aged": self.ageing.aged,
            "rejected": self.correction.rejected,
            "unjoined": max(0, len(self._parts) - 1),
            "ambiguous": self.search.ambiguous,
            "refused": self.search.refused,
        }

    def map(self) -> PlaceMap:
        """Return the keyframes whose poses are known relative to the oldest one: what can be saved."""
        return self.places.part(self._parts.oldest())

    def scans(self) -> KeyframeScans:
        """Return the range scans of the part of the map in which the pose is: the submaps that move with keyframes.

        Of a map that stays as it is, its own ones only.
        """
        sizes = len(self.places), len(self.places.links), len(self._parts)
        now = (self.places.next_id, self._parts.current, self.correction.optimisations, *sizes)
        if self._scans is None or self._scans[0] != now:
            shown = self._fixed if self._is_in_fixed else FixedPlaces(self.places, sorted(self._parts.ids()))
            loops = tuple((link.a, link.b) for link in self.places.links if link.is_loop)
            self._scans = now, KeyframeScans(shown.scans, shown.free_m, shown.poses, loops)
        return self._scans[1]

    def _advance(self, frame: OdometryFrame) -> None:
        """Sum up the path; after a gap of unknown motion, noticed or not, begin a new part of the map."""
        if self._last_T is not None:
            self._path_m += length_m(se3.inverse(self._last_T) @ frame.T_odom_rect)
        self._last_T = frame.T_odom_rect
        is_wrong = self.search.contradicted >= CONTRADICTIONS
        if is_wrong:  # and so are the keyframes since the first contradiction
            for id in [id for id, at_m in self._path_at.items() if at_m > self._confirmed_m]:
                self.places.drop(id)
            self._forget_dropped()
        if frame.resets != self._resets or is_wrong:
            self._resets, self.search.contradicted = frame.resets, 0
            self._hypotheses.clear()
            self._newest, self._recognised_at = None, None
            self._schedule.restart()
            self._parts.begin()
            self.correction.forget()

    def _search_is_due(self, frame: OdometryFrame) -> bool:
        """True if a recognition is to be checked, or where odom is in the map is not known."""
        is_unknown = self._recognised_at is None and any(map(self._is_place, self._parts.others()))
        is_pending = len(self._hypotheses) > 0 and self._state() is not MapState.LOCALIZED
        return self._schedule.search_is_due(
            frame.stamp_ns, frame.T_odom_rect, is_unknown=is_unknown, is_pending=is_pending
        )

    def _elsewhere(self) -> list[int]:
        """Return the keyframes of other parts of the map."""
        return [id for id in self._parts.others() if self._is_place(id)]

    def _is_place(self, id: int) -> bool:
        """True if a keyframe holds what recognises it."""
        return len(self.places.keyframes[id].features.views) > 0

    def _recognise(self, frame: OdometryFrame, small: Thumbnail, features: PlaceFeatures) -> Recognition | None:
        """Return the place that the frame shows: near the expected pose, else in parts of the map of unknown pose."""
        self._schedule.begin(frame.stamp_ns, frame.T_odom_rect)
        expected = self._expected(frame)
        found = self.search.near(small, features, self.places, expected)
        self._confirmed_m = self._confirmed_m if self.search.contradicted else self._path_m
        if found is None and (far := self._elsewhere()):
            found = self.search.far(small, features, self.places, far)
        self._schedule.end(found=found is not None, could_find=len(features.views) >= MIN_MATCHES)
        return found

    def _expected(self, frame: OdometryFrame) -> Expected:
        """Return the expected pose, and the largest errors relative to the keyframes that are no longer in view."""
        T_map_rect = self._T_map_odom @ frame.T_odom_rect
        ids = [id for id in self._around(T_map_rect[:3, 3]) if self._is_place(id)]
        drift_m = self._path_m - np.array([self._path_at.get(id, -math.inf) for id in ids])
        left = drift_m >= LOCAL_M
        ids, drift_m = [ids[n] for n in np.flatnonzero(left).tolist()], drift_m[left]
        if self._recognised_at is not None:
            path_m, at = self._recognised_at
            apart_m = np.linalg.norm(self.places.positions(ids) - at, axis=1)
            drift_m = np.minimum(drift_m, self._path_m - path_m + apart_m)
        error_m = dict(zip(ids, (GATE_M + GATE_PER_M * drift_m).tolist(), strict=True))
        error_rad = dict(zip(ids, (GATE_RAD + GATE_RAD_PER_M * drift_m).tolist(), strict=True))
        return Expected(T_map_rect, error_m, error_rad, self._state() is MapState.LOCALIZED)

    @property
    def _is_in_fixed(self) -> bool:
        """True if the current part is a fixed map."""
        return bool(self._fixed.ids) and self._parts.number(self._fixed.ids[0]) == self._parts.current

    def _around(self, position: Array) -> list[int]:
        """Return the keyframes of this part; of a fixed map only keyframes that may be near."""
        moving = [id for id in self._parts.ids() if id not in self._fixed.known]
        if not self._is_in_fixed or self._recognised_at is None:
            return moving
        # One that is farther than NEAR_M and the largest error, which grows with its distance, is not looked for.
        path_m, at = self._recognised_at
        drift_m = self._path_m - path_m + float(np.linalg.norm(position - at))
        reach_m = (NEAR_M + GATE_M + GATE_PER_M * drift_m) / (1 - GATE_PER_M)
        return self._fixed.within(position, reach_m) + moving

    def _add(self, frame: OdometryFrame, small: Thumbnail, features: PlaceFeatures) -> None:
        """Add a keyframe to the map."""
        if self._localize_only:
            features = NOTHING
            ties = [id for id in self.places.keyframes if id not in self._fixed.known]
            for id in ties[: len(ties) - TIES + 1]:
                self.places.drop(id)
        scan, free_m = frame.scan().astype(np.float16), frame.free_m().astype(np.float16)
        of_odometry = frame.stamp_ns, frame.T_odom_rect, frame.covariance
        id = self.places.next_id
        keyframe = PlaceKeyframe(id, self._session, *of_odometry, small, scan, free_m, features)
        link = None if self._newest is None else by_odometry(self._newest, keyframe)
        self.places.add(keyframe, self._T_map_odom @ frame.T_odom_rect, link)
        self._parts.add(keyframe.id)
        self._path_at[keyframe.id] = self._path_m
        self._newest = keyframe
        self._forget_dropped()

    def _forget_dropped(self) -> None:
        """Forget the keyframes that are no longer in the map."""
        if self._parts.forget_dropped():
            self._path_at = {id: at for id, at in self._path_at.items() if id in self.places.keyframes}
            self.search.forget(self.places)

    def _age(self, found: Recognition) -> None:
        """Count what the search found and missed at a place that is known; what has aged leaves the map."""
        if self._localize_only or self._state() is not MapState.LOCALIZED:
            return
        at = (self.places.poses[found.id] @ found.T_place_rect)[:3, 3]
        self.ageing.observe(at, self.search.compared, self._path_m)
        self._forget_dropped()

    def _close_loop(self, frame: OdometryFrame, found: Recognition, newest: PlaceKeyframe) -> None:
        """Link a recognised place, once several frames agree, and correct the map."""
        T_keyframe_rect = se3.inverse(newest.T_odom_rect) @ frame.T_odom_rect
        since = relative_covariance(T_keyframe_rect, newest.covariance, frame.covariance)
        hypothesis = Hypothesis(found, newest.id, T_keyframe_rect, since, frame.T_odom_rect)
        if not (consistent := self._hypotheses.add(hypothesis, self.places.poses)):
            return
        other = self._parts.number(found.id)
        if other != self._parts.current:
            self._parts.join(other, hypothesis.T_map_odom(self.places.poses) @ se3.inverse(self._T_map_odom))
            self.correction.forget()
        links = [one.link() for one in consistent if self._hypotheses.take(one)]
        self.correction.close(
            [link for link in links if link.a != link.b], sorted(self._parts.ids()), self._fixed.known
        )
        self._T_map_odom = self.places.poses[newest.id] @ se3.inverse(newest.T_odom_rect)
        self._recognised_at = self._path_m, (self._T_map_odom @ frame.T_odom_rect)[:3, 3]

    def _state(self) -> MapState:
        """Return the state of a frame whose pose in odom is known."""
        recent = self._recognised_at is not None and self._path_m - self._recognised_at[0] < RECENT_M
        return MapState.LOCALIZED if recent else MapState.ODOMETRY_ONLY

    def _pose(self, frame: OdometryFrame, state: MapState) -> MapPose:
        """Return the pose of odom at a frame, relative to the newest keyframe where there is one."""
        is_unknown = self._recognised_at is None and bool(self._elsewhere())
        covariance = UNKNOWN_PLACE if is_unknown else self.correction.covariance_at(frame.T_odom_rect, frame.covariance)
        newest = self._newest
        if newest is None:
            return MapPose(self._T_map_odom, covariance, state, NO_KEYFRAME, np.eye(4))
        T_keyframe_rect = se3.inverse(newest.T_odom_rect) @ frame.T_odom_rect
        return MapPose(self._T_map_odom, covariance, state, newest.id, T_keyframe_rect)
