"""Collects the AprilTags that a run sees, and gives their poses at its end."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.map_tags import MOST_REJECTED
from omnid.core.places.tags import TagEstimate, TagFinder, fused, in_tag_axes
from omnid.messages import MapKeyframes, OdometryUpdate, PlaceUpdate
from omnid.sinks.encoder import Outgoing
from omnid.stages.geometry import Geometry
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]

NOISE_PX: Final = 0.1  # Noise of the odometry's corners in the stereo model, which the search of tags does not use.
MOVED_M: Final = 0.1  # Motion between two frames that are searched.
MOVED_RAD: Final = math.radians(10)
MAX_VIEWS: Final = 1000  # Most views of a tag.
# Newest poses in the map that are kept: where stages have threads, that of a pair may come before the pair itself does,
# by as many as wait in the inbox of a stage, two.
MOST_RECENT: Final = 8


class _TagView(NamedTuple):
    """A tag in a pair."""

    seq: int
    T_rig_tag: Array
    covariance: Array  # (6, 6) in the axes of the tag
    T_odom_rig: Array


class TagCollector:
    """A sink of a run: searches tags in its frames, and keeps the poses in the map at which it found some."""

    def __init__(self, geometry: Geometry, sizes_m: Mapping[int, float]) -> None:
        """sizes_m: edge of the black square of each tag, by its id."""
        self._finder = TagFinder(geometry.model(NOISE_PX), sizes_m)
        self._T_base_rig, self._T_rig_rect = geometry.rig.T_base_rig, geometry.T_rig_rect
        self._seen: dict[int, list[_TagView]] = {}
        self._poses: dict[int, PlaceUpdate | None] = {}  # in the map, by the pairs in which a tag was seen
        self._recent: deque[PlaceUpdate] = deque(maxlen=MOST_RECENT)
        self._keyframes: MapKeyframes | None = None  # as they were last
        self._last_T: Array | None = None

    @property
    def refused(self) -> int:
        """Tags that are not of the size that is given."""
        return self._finder.refused

    def process(self, message: Outgoing) -> None:
        """Take a pose in the map, or search a frame where the rig has moved."""
        if isinstance(message, PlaceUpdate):
            self._keep_pose(message)
        elif isinstance(message, OdometryUpdate) and message.state is TrackingState.TRACKING and self._is_due(message):
            self._search(message)

    def _keep_pose(self, update: PlaceUpdate) -> None:
        """Keep the pose of a pair in the map: for its views, and for a while, as its frame may come later."""
        self._keyframes = update.keyframes
        pose = replace(update, scans=None, keyframes=None)
        self._recent.append(pose)
        if update.seq in self._poses:
            self._poses[update.seq] = pose

    def _search(self, odometry: OdometryUpdate) -> None:
        """Search tags in a frame, and keep the views of those that have not too many yet."""
        self._last_T = odometry.T_odom_rig
        panoramas = odometry.depth.panoramas
        for tag in self._finder.process(panoramas.lower, panoramas.upper):
            views = self._seen.setdefault(tag.id, [])
            if len(views) < MAX_VIEWS:
                T_rig_tag = self._T_rig_rect @ tag.T_rect_tag
                views.append(_TagView(odometry.seq, T_rig_tag, in_tag_axes(tag), odometry.T_odom_rig))
                known = (pose for pose in self._recent if pose.seq == odometry.seq)
                self._poses.setdefault(odometry.seq, next(known, None))

    def _is_due(self, odometry: OdometryUpdate) -> bool:
        if self._last_T is None:
            return True
        moved = se3.inverse(self._last_T) @ odometry.T_odom_rig
        turned_rad = math.acos(min(1.0, max(-1.0, (float(np.trace(moved[:3, :3])) - 1) / 2)))
        return float(np.linalg.norm(moved[:3, 3])) >= MOVED_M or turned_rad >= MOVED_RAD

    def tags(self) -> dict[int, TagEstimate]:
        """Return the tags by their ids; poses in the map, in the axes of the base at its start.

        Tags that contradicting views show in several places are left out.
        """
        found = {
            id: fused(
                [self._T_base_rig @ self._T_map_rig(view) @ view.T_rig_tag for view in views],
                [view.covariance for view in views],
            )
            for id, views in sorted(self._seen.items())
        }
        return {id: tag for id, tag in found.items() if tag.rejected <= MOST_REJECTED * len(self._seen[id])}

    def _T_map_rig(self, view: _TagView) -> Array:
        """Return the pose of the rig at a view as the map knows it at the end; without a map that in odom."""
        pose = self._poses[view.seq]
        if pose is None:
            return view.T_odom_rig
        T_map_rect = None if self._keyframes is None else self._keyframes.T_map_rect.get(pose.keyframe)
        if T_map_rect is None:
            return pose.T_map_rig
        return np.asarray(self._T_rig_rect @ T_map_rect @ se3.inverse(self._T_rig_rect) @ pose.T_keyframe_rig)
