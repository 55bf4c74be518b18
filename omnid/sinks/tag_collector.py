"""Collects the AprilTags that a run sees, and gives their poses at its end."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.tags import TagEstimate, TagFinder, fused, in_tag_axes
from omnid.messages import OdometryUpdate, PlaceUpdate
from omnid.sinks.encoder import Outgoing
from omnid.stages.geometry import Geometry
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]

NOISE_PX: Final = 0.1  # Noise of a corner of odometry: not used for tags.
MOVED_M: Final = 0.1  # Motion between two frames that are searched.
MOVED_RAD: Final = math.radians(10)
MAX_VIEWS: Final = 1000  # Most views of a tag.


class TagCollector:
    """A sink of all messages of a run."""

    def __init__(self, geometry: Geometry, sizes_m: Mapping[int, float]) -> None:
        """sizes_m: edge of the black square of each tag, by its id."""
        self._finder = TagFinder(geometry.model(NOISE_PX), sizes_m)
        self._T_base_rig, self._T_rig_rect = geometry.rig.T_base_rig, geometry.T_rig_rect
        self._seen: dict[int, list[tuple[Array, Array]]] = {}
        self._last_T: Array | None = None
        self._T_map_odom = np.eye(4)

    @property
    def refused(self) -> int:
        """Tags that are not of the size that is given."""
        return self._finder.refused

    def process(self, message: Outgoing) -> None:
        """Search a frame where the rig has moved."""
        if isinstance(message, PlaceUpdate):
            self._T_map_odom = message.T_map_odom
        elif isinstance(message, OdometryUpdate) and message.state is TrackingState.TRACKING and self._is_due(message):
            self._last_T = message.T_odom_rig
            panoramas = message.depth.panoramas
            for tag in self._finder.process(panoramas.lower, panoramas.upper):
                views = self._seen.setdefault(tag.id, [])
                if len(views) < MAX_VIEWS:
                    views.append((message.T_odom_rig @ self._T_rig_rect @ tag.T_rect_tag, in_tag_axes(tag)))

    def _is_due(self, odometry: OdometryUpdate) -> bool:
        if self._last_T is None:
            return True
        moved = se3.inverse(self._last_T) @ odometry.T_odom_rig
        turned_rad = math.acos(min(1.0, max(-1.0, (float(np.trace(moved[:3, :3])) - 1) / 2)))
        return float(np.linalg.norm(moved[:3, 3])) >= MOVED_M or turned_rad >= MOVED_RAD

    def tags(self) -> dict[int, TagEstimate]:
        """Return the tags by their ids; poses in the map, in the axes of the base at its start."""
        T_map_odom = self._T_base_rig @ self._T_map_odom
        return {
            id: fused([T_map_odom @ T for T, _ in views], [covariance for _, covariance in views])
            for id, views in sorted(self._seen.items())
        }
