"""Localisation in a map: keep keyframes of odometry, recognise places, close loops, and give the pose of odom.

MapLocaliser.process is the algorithm, one frame at a time. Odometry stays as it is; T_map_odom carries the correction.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.scan_grid import KeyframeScans
from omnid.core.nanoseconds import NS_PER_S, STAMP_JITTER_NS
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.correction import MapCorrection
from omnid.core.places.features import Thumbnail, describe, thumbnail
from omnid.core.places.place_map import NO_KEYFRAME, Link, PlaceFeatures, PlaceKeyframe, PlaceLimits, PlaceMap
from omnid.core.places.recognition import (
    FAR,
    GATE_M,
    GATE_RAD,
    MIN_MATCHES,
    NEAR_M,
    Expected,
    PlaceSearch,
    Recognition,
    motion_between,
)
from omnid.core.types.stereo_model import StereoModel
from omnid.tracking_state import MapState

Array = NDArray[np.float64]

# Set by trial on development seeds, where a line gives no other reason.
RECENT_M: Final = 15.0  # A pose counts as localised up to this length of path after the last recognition.
CONSISTENT: Final = 3  # recognitions that give the same pose, before they count
# After this number of searches in a row without success, only new keyframes are searched for. After this number of
# recognitions in a row that odometry contradicts, odometry has missed a motion: without one there were 3.
SEARCHES: Final = 10
# Covariance in a map of which nothing has been recognised, m^2 and rad^2, because it may be a kilometre away in any
# direction.
UNKNOWN_PLACE: Final[Array] = np.diag([1e6] * 3 + [np.pi**2] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class OdometryFrame:
    """A frame with its pose by odometry."""

    stereo: StereoFrame
    stamp_ns: int
    T_odom_rect: Array  # (4, 4)
    covariance: Array  # (6, 6) of T_odom_rect, [t; r] in the rectified frame: m^2, m rad, rad^2
    lost: bool
    resets: int  # gaps of unknown motion so far
    is_keyframe: bool  # True if its dense depth is known
    # Returns distances (SECTORS,) [m] and up to where floor was seen, see mapping/range_scan.py; asked at a keyframe.
    ranges: Callable[[], tuple[NDArray[np.float32], NDArray[np.float32]]]


@dataclass(frozen=True, slots=True, eq=False)
class MapPose:
    """Pose of odom in the map, and pose of the frame in the newest keyframe."""

    T_map_odom: Array  # (4, 4); odom is the rectified frame of the first pair
    covariance: Array  # (6, 6) of T_map_rect, the pose of the frame in the map; [t; r] in the rectified frame
    state: MapState
    keyframe: int  # id of the newest keyframe of the run; NO_KEYFRAME: none since the last gap
    T_keyframe_rect: Array  # (4, 4) pose of the frame in that keyframe by odometry; the identity where there is none
    is_known: bool  # True if it is known where odom lies in the map


@dataclass(slots=True, eq=False)
class Hypothesis:
    """A frame that was recognised at a place."""

    place: Recognition
    T_odom_rect: Array  # (4, 4) of the frame
    link: Link  # from the place to the keyframe that was the newest one of the run then
    is_counted: bool = False  # it is a loop of the map already

    def T_map_odom(self, poses: Mapping[int, Array]) -> Array:
        """Return the pose of odom in the map of these poses of keyframes."""
        return np.asarray(poses[self.place.id] @ self.place.T_place_rect @ se3.inverse(self.T_odom_rect))


def consistent_hypotheses(kept: Iterable[Hypothesis], new: Hypothesis, poses: Mapping[int, Array]) -> list[Hypothesis]:
    """Return the recognitions that agree with a new one, which is the last of them; none if there are too few.

    Both must place the newer frame at the same pose in the map. Frames at one place count as one, unless they have
    many inliers.
    """
    T_map_new, distinct = new.T_map_odom(poses) @ new.T_odom_rect, list[Hypothesis]()
    for one in (*kept, new):
        if one.place.id in poses and one.link.b in poses:
            moved_m, turned_rad = motion_between(one.T_map_odom(poses) @ new.T_odom_rect, T_map_new)
            if moved_m < GATE_M and turned_rad < GATE_RAD and _is_distinct(one, distinct):
                distinct.append(one)
    return distinct if len(distinct) >= CONSISTENT else []


def _is_distinct(one: Hypothesis, others: list[Hypothesis]) -> bool:
    """True if a recognition counts besides others: it has many inliers, or its frame is apart from theirs.

    Many inliers count without motion, as a robot may be at rest.
    """
    if one.place.inliers >= FAR.inliers:
        return True
    moved = (motion_between(one.T_odom_rect, other.T_odom_rect) for other in others)
    return all(moved_m > GATE_M or turned_rad > GATE_RAD for moved_m, turned_rad in moved)


class MapLocaliser:
    """Holds the map, and the pose of odom in it."""

    def __init__(
        self, model: StereoModel, limits: PlaceLimits, places: PlaceMap | None = None, *, localize_only: bool = False
    ) -> None:
        """places: a map to be extended; None: a new one, which begins where odom does. localize_only: the map stays as
        it is; the newest keyframes of the run tie odom to it, and are no places.
        """
        self._limits, self._period_ns = limits, NS_PER_S / limits.rate_hz - STAMP_JITTER_NS
        self.places = places if places is not None else PlaceMap()
        self._localize_only = localize_only
        self._fixed = frozenset(self.places.keyframes if localize_only else ())  # keyframes (ids) that stay
        self.places.max_keyframes = len(self._fixed) + limits.max_keyframes
        # A map has the columns of full turns, whatever sector of them the cameras show.
        self.search = PlaceSearch(replace(model, cylinder=model.cylinder.full_turn))
        self.correction = MapCorrection(self.places)
        self._session = 1 + max((k.session for k in self.places.keyframes.values()), default=-1)
        self._hypotheses: deque[Hypothesis] = deque(maxlen=2 * CONSISTENT)
        self._newest: PlaceKeyframe | None = None  # newest keyframe of this part, placed by odometry
        self._T_map_odom = np.eye(4)
        self._resets = 0
        self._path_m = self._confirmed_m = 0.0  # m: the path, and that at the last search before contradictions
        self._path_at: dict[int, float] = {}  # m, of the keyframes of this run
        self._recognised_at: tuple[float, Array] | None = None  # path and place of the last recognition that counted
        self._last_T = np.eye(4)
        self._searched: tuple[int, Array] | None = None  # stamp and T_odom_rect of the last search
        self.failed = 0  # searches in a row, in this part of the map, that found nothing
        self._part: frozenset[int] | None = None  # keyframes that links join to the newest one; None: not known
        self._scans: KeyframeScans | None = None  # of this part; None: it has changed

    def process(self, frame: OdometryFrame) -> MapPose:
        """Return the pose of odom in the map after a frame."""
        self._advance(frame)
        if frame.lost:
            return self._pose(frame, MapState.LOST)
        is_keyframe = self._keyframe_is_due(frame)
        if is_keyframe or self._search_is_due(frame):
            small, features = thumbnail(frame.stereo.lower), describe(frame.stereo)
            # 1. Recognise: a shortlist by thumbnails, matches, RANSAC, Gauss-Newton; not what is ambiguous.
            found = self._recognise(frame, small, features)
            # 2. Keep the keyframe, linked to the one before by odometry.
            if is_keyframe:
                self._add(frame, small, features)
            # 3. Correct the map where several frames agree; a full one may just have dropped the recognised keyframe.
            if found is not None and self._newest is not None and found.id in self.places.poses:
                self._close_loop(frame, found, self._newest)
        return self._pose(frame, self._state())

    @property
    def counts(self) -> dict[str, int]:
        """Sizes and counters, for the status."""
        return {
            "keyframes": len(self.places),
            "loops": self.places.loops,
            "dropped": self.places.dropped,
            "unjoined": max(0, len(self.places.parts()) - 1),
        }

    def map(self) -> PlaceMap:
        """Return the keyframes whose poses are known relative to the oldest one: what can be saved."""
        oldest = min(self.places.keyframes, default=0)
        return self.places.part(next((part for part in self.places.parts() if oldest in part), []))

    def scans(self) -> KeyframeScans:
        """Return the range scans of the part of the map in which the pose is: the submaps that move with keyframes.

        Of a map that stays as it is, its own ones only. The same object until they change.
        """
        if self._scans is None:
            self._scans = self.places.scans(sorted(self._fixed & self._current or self._current))
        return self._scans

    @property
    def _current(self) -> frozenset[int]:
        """The keyframes (ids) of the part of the map in which the pose is: those that links join to the newest one."""
        if self._part is None:
            newest = None if self._newest is None else self._newest.id
            self._part = frozenset(next((part for part in self.places.parts() if newest in part), []))
        return self._part

    def _elsewhere(self) -> list[int]:
        """Return the keyframes of other parts of the map that hold what recognises them."""
        return [id for id in self.places.keyframes if id not in self._current and self._is_place(id)]

    def _is_place(self, id: int) -> bool:
        return len(self.places.keyframes[id].features.views) > 0

    def _map_changed(self) -> None:
        """Forget what was computed of the map before it changed."""
        self._part = self._scans = None
        self._path_at = {id: at for id, at in self._path_at.items() if id in self.places.keyframes}

    def _advance(self, frame: OdometryFrame) -> None:
        """Sum up the path; after a gap of unknown motion, noticed or not, begin a new part of the map."""
        self._path_m += motion_between(self._last_T, frame.T_odom_rect)[0]
        self._last_T = frame.T_odom_rect
        is_wrong = self.search.contradicted >= SEARCHES
        if is_wrong:  # and so are the keyframes since the first contradiction
            for id in [id for id, at_m in self._path_at.items() if at_m > self._confirmed_m]:
                self.places.drop(id)
        if frame.resets != self._resets or is_wrong:
            self._resets, self.search.contradicted = frame.resets, 0
            self._hypotheses.clear()
            self._newest = self._recognised_at = self._searched = None
            self.failed = 0
            self._map_changed()
            self.correction.forget()

    def _keyframe_is_due(self, frame: OdometryFrame) -> bool:
        """True if the view has changed enough since the newest keyframe.

        Odometry computes dense depth at its own keyframes. Where it makes none, the map waits for twice the distance
        between its keyframes before it asks for dense depth itself.
        """
        newest, limits = self._newest, self._limits
        if newest is None:
            return True
        if frame.stamp_ns - newest.stamp_ns < self._period_ns:
            return False
        moved_m, turned_rad = motion_between(newest.T_odom_rect, frame.T_odom_rect)
        change = max(moved_m / limits.keyframe_m, turned_rad / math.radians(limits.keyframe_deg))
        return change >= (1 if frame.is_keyframe else 2)

    def _search_is_due(self, frame: OdometryFrame) -> bool:
        """True for a frame that becomes no keyframe if a recognition is to be checked, or odom's place is not known."""
        if self._searched is None:
            return True
        searched_ns, T_odom_searched = self._searched
        if frame.stamp_ns - searched_ns < self._period_ns:
            return False
        if self.failed < SEARCHES and self._recognised_at is None and self._elsewhere():
            return True
        moved_m, turned_rad = motion_between(T_odom_searched, frame.T_odom_rect)
        is_pending = len(self._hypotheses) > 0 and self._state() is not MapState.LOCALIZED
        return is_pending and (moved_m > GATE_M or turned_rad > GATE_RAD)

    def _recognise(self, frame: OdometryFrame, small: Thumbnail, features: PlaceFeatures) -> Recognition | None:
        """Return the place that the frame shows: near the expected pose, else in parts of the map of unknown pose."""
        self._searched = frame.stamp_ns, frame.T_odom_rect
        found = self.search.find(small, features, self.places, self._expected(frame))
        self._confirmed_m = self._confirmed_m if self.search.contradicted else self._path_m
        if found is None and (elsewhere := self._elsewhere()):
            found = self.search.find(small, features, self.places, elsewhere)
        if found is not None:
            self.failed = 0
        elif len(features.views) >= MIN_MATCHES:  # it was not too dark to search
            self.failed += 1
        return found

    def _expected(self, frame: OdometryFrame) -> Expected:
        """Return the expected pose, and the drift since the keyframes that are no longer in view."""
        # 1. Since odometry has left a keyframe of this run.
        ids = [id for id in sorted(self._current) if self._is_place(id)]
        drift_m = self._path_m - np.array([self._path_at.get(id, -math.inf) for id in ids])
        left = drift_m >= 2 * NEAR_M  # odometry itself still sees what is nearer along the path
        ids, drift_m = [ids[n] for n in np.flatnonzero(left).tolist()], drift_m[left]
        # 2. Since the map last said where odom is, and from there to the keyframe.
        if self._recognised_at is not None:
            path_m, at = self._recognised_at
            apart_m = np.linalg.norm(self.places.positions(ids) - at, axis=1)
            drift_m = np.minimum(drift_m, self._path_m - path_m + apart_m)
        T_map_rect = self._T_map_odom @ frame.T_odom_rect
        is_localised = self._state() is MapState.LOCALIZED
        return Expected(T_map_rect, dict(zip(ids, drift_m.tolist(), strict=True)), is_localised)

    def _add(self, frame: OdometryFrame, small: Thumbnail, features: PlaceFeatures) -> None:
        """Add a keyframe to the map."""
        if self._localize_only:
            features = features.first(0)
            ties = [id for id in self.places.keyframes if id not in self._fixed]
            for id in ties[: len(ties) - self._limits.max_keyframes + 1]:
                self.places.drop(id)
        scan, free_m = (ranges.astype(np.float16) for ranges in frame.ranges())
        of_odometry = frame.stamp_ns, frame.T_odom_rect, frame.covariance
        next_id = max(self.places.keyframes, default=-1) + 1
        keyframe = PlaceKeyframe(next_id, self._session, *of_odometry, small, scan, free_m, features)
        link = None if self._newest is None else Link.by_odometry(self._newest, keyframe)
        self.places.add(keyframe, self._T_map_odom @ frame.T_odom_rect, link)
        self._path_at[keyframe.id] = self._path_m
        self._newest = keyframe
        self._map_changed()

    def _close_loop(self, frame: OdometryFrame, found: Recognition, newest: PlaceKeyframe) -> None:
        """Link a recognised place, once several frames agree, and correct the map."""
        # 1. The recognition, with those before it that agree.
        link = Link(found.id, -1, found.T_place_rect, found.covariance, found.inliers)
        link = link.then(Link(newest.id, -1, *newest.relative_pose(frame.T_odom_rect, frame.covariance)).reversed())
        hypothesis, poses = Hypothesis(found, frame.T_odom_rect, link), self.places.poses
        consistent = consistent_hypotheses(self._hypotheses, hypothesis, poses)
        self._hypotheses.append(hypothesis)
        if not consistent:
            return
        # 2. A place in another part joins the two; the older one stays where it is.
        part = self._current
        if found.id not in part:
            other = next(frozenset(ids) for ids in self.places.parts() if found.id in ids)
            T_other_current = hypothesis.T_map_odom(poses) @ se3.inverse(self._T_map_odom)
            moved, by = (part, T_other_current) if min(other) < min(part) else (other, se3.inverse(T_other_current))
            poses.update({id: by @ poses[id] for id in moved})
            part |= other
            self.correction.forget()
        # 3. Loops, and the poses by them.
        links = [one.link for one in consistent if not one.is_counted]
        for one in consistent:
            one.is_counted = True
        self.correction.close([link for link in links if link.a != link.b], sorted(part), self._fixed)
        self._T_map_odom = poses[newest.id] @ se3.inverse(newest.T_odom_rect)
        self._recognised_at = self._path_m, (self._T_map_odom @ frame.T_odom_rect)[:3, 3]
        self._map_changed()

    def _state(self) -> MapState:
        """Return the state of a frame whose pose in odom is known."""
        recent = self._recognised_at is not None and self._path_m - self._recognised_at[0] < RECENT_M
        return MapState.LOCALIZED if recent else MapState.ODOMETRY_ONLY

    def _pose(self, frame: OdometryFrame, state: MapState) -> MapPose:
        """Return the pose of odom at a frame, relative to the newest keyframe where there is one."""
        is_known = self._recognised_at is not None or not self._elsewhere()
        covariance = UNKNOWN_PLACE
        if is_known:
            covariance = self.correction.covariance_at(frame.T_odom_rect, frame.covariance)
        id, T_keyframe_rect = NO_KEYFRAME, np.eye(4)
        if self._newest is not None:
            id, T_keyframe_rect = self._newest.id, se3.inverse(self._newest.T_odom_rect) @ frame.T_odom_rect
        return MapPose(self._T_map_odom, covariance, state, id, T_keyframe_rect, is_known)
