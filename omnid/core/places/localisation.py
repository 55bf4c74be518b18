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
from omnid.core.mapping.keyframe_grid import KeyframeScans
from omnid.core.places.ageing import Ageing
from omnid.core.places.correction import MapCorrection
from omnid.core.places.drift import relative_covariance
from omnid.core.places.features import describe
from omnid.core.places.fixed_places import FixedPlaces
from omnid.core.places.hypotheses import Hypotheses, Hypothesis, length_m
from omnid.core.places.keyframe_id import NO_KEYFRAME
from omnid.core.places.limits import PlaceLimits
from omnid.core.places.map_parts import MapParts
from omnid.core.places.map_pose import UNKNOWN_PLACE, MapPose, OdometryFrame
from omnid.core.places.place_features import NOTHING, PlaceFeatures
from omnid.core.places.place_map import PlaceKeyframe, PlaceMap, by_odometry
from omnid.core.places.place_search import NEAR_M, Expected, PlaceSearch
from omnid.core.places.recognition import MIN_MATCHES, Recognition
from omnid.core.places.scan_localiser import ScanLocaliser
from omnid.core.places.search_schedule import SearchSchedule
from omnid.core.places.signature import Thumbnail, thumbnail
from omnid.core.places.tag_recognition import TagRecogniser
from omnid.core.places.tags import TagPose
from omnid.core.types.stereo_model import StereoModel
from omnid.tracking_state import MapState

Array = NDArray[np.float64]

LOCAL_M: Final = 3.0  # Loops closer along the path are ignored, because odometry itself still sees what is that near.
TIES: Final = 50  # newest keyframes kept besides a fixed map, so that memory is bounded
# Largest error of odometry, and its growth with the path; by trial on development seeds.
GATE_M, GATE_PER_M = 0.15, 0.05
GATE_RAD, GATE_RAD_PER_M = math.radians(3), math.radians(0.4)  # The same of the heading; by trial on development seeds.
TAG_SIGMAS: Final = 3.0  # Accepted error of a pose by a tag, because 0.3 % of right poses exceed it.
# After so many contradictions in a row odometry has missed a motion, because right ones in worlds that repeat had 3.
CONTRADICTIONS: Final = 10
# A pose counts as localised up to this length of path after the last recognition. By judgement; not measured.
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
        bounds = (len(self._fixed.ids) + TIES + 1, None) if localize_only else (limits.max_keyframes, limits.max_bytes)
        self.places.bound(*bounds)
        # A map has the columns of full turns, whatever sector of them the cameras show.
        self.search = PlaceSearch(replace(model, cylinder=model.cylinder.full_turn))
        self._tags = TagRecogniser(model, self.places) if self.places.tags else None
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
        self._by_tag = False  # it was a tag, which gives the pose less exactly than a view
        self._last_T: Array | None = None
        self._scans: tuple[object, KeyframeScans] | None = None  # what they depend on, and they
        self._by_scan = ScanLocaliser(self.places) if limits.by_scan and self.places.keyframes else None

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
            tags = self._tags.find(frame.stereo) if self._tags else []
            found = self._recognise(frame, small, features, tags)
            # 2. Keep the keyframe, linked to the one before by odometry.
            if is_keyframe:
                self._add(frame, small, features, tags)
            # 3. Correct the map where several frames agree; a full one may just have dropped the recognised keyframe.
            if found is not None and self._newest is not None and found.id in self.places.poses:
                self._close_loop(frame, found, self._newest)
                self._age(found)
        # 4. In a saved map of which nothing is recognised, the shape of the room may give the pose.
        if self._by_scan is not None and self._recognised_at is None and self._schedule.wants_scans:
            by_scan = self._by_scan.process(frame.T_odom_rect, frame.scan, self._proposed(frame))
            if by_scan is not None:
                return MapPose(by_scan.T_map_odom, by_scan.covariance, MapState.LOCALIZED, NO_KEYFRAME, np.eye(4))
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
            **({} if self.places.stored is None else self.places.stored.store.counts),
            **({} if self._tags is None else self._tags.counts),
            **({} if self._by_scan is None else {"scan_ambiguous": self._by_scan.ambiguous}),
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
            if self._by_scan is not None:
                self._by_scan.restart()
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
        return self.places.keyframes[id].features.count > 0

    def _recognise(
        self, frame: OdometryFrame, small: Thumbnail, features: PlaceFeatures, tags: list[TagPose]
    ) -> Recognition | None:
        """Return the place that the frame shows: near the expected pose, else in parts of the map of unknown pose."""
        self._schedule.begin(frame.stamp_ns, frame.T_odom_rect)
        expected = self._expected(frame)
        found = self.search.near(small, features, self.places, expected)
        self._confirmed_m = self._confirmed_m if self.search.contradicted else self._path_m
        if found is None and (far := self._elsewhere()):
            by_scan = None if self._by_scan is None else self._by_scan.T_map_rect(frame.T_odom_rect)
            found = self.search.far(small, features, self.places, far, by_scan)
        if found is None and tags and self._tags is not None:
            found = self._recognise_by_tag(self._tags, tags, expected)
        self._schedule.end(found=found is not None, could_find=len(features.views) >= MIN_MATCHES)
        return found

    def _recognise_by_tag(
        self, recogniser: TagRecogniser, tags: list[TagPose], expected: Expected
    ) -> Recognition | None:
        """Return the place of a frame by a tag: as odometry expects it, else in the oldest other part that has it."""
        near = recogniser.recognise(tags, expected.error_m)
        if near is not None:
            return self.search.expected_only(near, self.places, expected)
        far = self._elsewhere()
        for part in sorted({self._parts.number(id) for id in far}):
            found = recogniser.recognise(tags, {id for id in far if self._parts.number(id) == part})
            if found is not None:
                return found
        return None

    def _proposed(self, frame: OdometryFrame) -> list[Array]:
        """Return the poses (4, 4) in the map that the last search suggests for a frame, ambiguous ones too."""
        if not self._schedule.has_searched:
            return []
        return [T @ self._schedule.motion_since(frame.T_odom_rect) for T in self.search.proposed(self.places.poses)]

    def _expected(self, frame: OdometryFrame) -> Expected:
        """Return the expected pose, and the largest errors relative to the keyframes that are no longer in view."""
        T_map_rect = self._T_map_odom @ frame.T_odom_rect
        # A pose by a tag may err by more than odometry since then.
        P = self.correction.covariance_at(frame.T_odom_rect, frame.covariance)
        sigmas = np.sqrt([np.trace(P[:3, :3]), np.trace(P[3:, 3:])]) if self._by_tag else np.zeros(2)
        slack_m, slack_rad = (TAG_SIGMAS * sigmas).tolist()
        ids = [id for id in self._around(T_map_rect[:3, 3], slack_m) if self._is_place(id)]
        drift_m = self._path_m - np.array([self._path_at.get(id, -math.inf) for id in ids])
        left = drift_m >= LOCAL_M
        ids, drift_m = [ids[n] for n in np.flatnonzero(left).tolist()], drift_m[left]
        if self._recognised_at is not None:
            path_m, at = self._recognised_at
            apart_m = np.linalg.norm(self.places.positions(ids) - at, axis=1)
            drift_m = np.minimum(drift_m, self._path_m - path_m + apart_m)
        error_m = dict(zip(ids, (slack_m + GATE_M + GATE_PER_M * drift_m).tolist(), strict=True))
        error_rad = dict(zip(ids, (slack_rad + GATE_RAD + GATE_RAD_PER_M * drift_m).tolist(), strict=True))
        return Expected(T_map_rect, error_m, error_rad, self._state() is MapState.LOCALIZED)

    @property
    def _is_in_fixed(self) -> bool:
        """True if the current part is a fixed map."""
        return bool(self._fixed.ids) and self._parts.number(self._fixed.ids[0]) == self._parts.current

    def _around(self, position: Array, slack_m: float) -> list[int]:
        """Return the keyframes of this part; of a fixed map only keyframes that may be near, or that saw tags."""
        moving = [id for id in self._parts.ids() if id not in self._fixed.known]
        if not self._is_in_fixed or self._recognised_at is None:
            return moving
        # One that is farther than NEAR_M and the largest error, which grows with its distance, is not looked for.
        path_m, at = self._recognised_at
        drift_m = self._path_m - path_m + float(np.linalg.norm(position - at))
        reach_m = (NEAR_M + slack_m + GATE_M + GATE_PER_M * drift_m) / (1 - GATE_PER_M)
        return self._fixed.within(position, reach_m, {view.keyframe for view in self.places.tags.views}) + moving

    def _add(self, frame: OdometryFrame, small: Thumbnail, features: PlaceFeatures, tags: list[TagPose]) -> None:
        """Add a keyframe to the map, with the tags that it shows."""
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
        if self._tags is not None and not self._localize_only:
            self.places.tags.add(self._tags.views(tags, keyframe.id))
        self._forget_dropped()

    def _forget_dropped(self) -> None:
        """Forget the keyframes that are no longer in the map."""
        if self._parts.forget_dropped():
            self._path_at = {id: at for id, at in self._path_at.items() if id in self.places.keyframes}
            self.search.forget(self.places)

    def _age(self, found: Recognition) -> None:
        """Count what the search found and missed at a place that is known; what has aged leaves the map."""
        if found.by_tag or self._localize_only or self._state() is not MapState.LOCALIZED:
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
        self._by_tag = found.by_tag

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
