"""Recognition of a place by an AprilTag that the map knows."""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Final

import numpy as np

from calib import se3
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.map_tags import TagView
from omnid.core.places.place_map import PlaceMap
from omnid.core.places.recognition import Recognition
from omnid.core.places.tags import TagFinder, TagPose, in_tag_axes
from omnid.core.types.stereo_model import StereoModel

CORNERS_SEEN: Final = 8  # Corners of a tag in both panoramas; because all four are needed in each.


class TagRecogniser:
    """Finds the tags of a map in frames, and counts those whose place is not clear."""

    def __init__(self, model: StereoModel, places: PlaceMap) -> None:
        self._places = places
        self._finder = TagFinder(model, {tag.id: tag.size_m for tag in places.tags.known.values()})
        self.ambiguous = 0  # tags that hang in several places

    @property
    def counts(self) -> dict[str, int]:
        """Sizes and counters, for the status."""
        tags = self._places.tags
        return {
            "tags_seen": len({view.tag for view in tags.views}),
            "tag_views": len(tags.views),
            "tag_views_forgotten": tags.forgotten,
            "tags_ambiguous": self.ambiguous,
            "tags_of_other_size": self._finder.refused,
        }

    def find(self, frame: StereoFrame) -> list[TagPose]:
        """Return the tags that a frame shows."""
        return self._finder.process(frame.lower, frame.upper)

    def recognise(self, seen: Sequence[TagPose], among: Container[int]) -> Recognition | None:
        """Return the place of a frame by the tag that gives it most certainly.

        among: ids of the keyframes to which the place may be relative.
        """
        found = [place for place in (self._place(tag, among) for tag in seen) if place is not None]
        return min(found, key=lambda place: float(np.trace(place.covariance[:3, :3])), default=None)

    def _place(self, seen: TagPose, among: Container[int]) -> Recognition | None:
        tags, poses = self._places.tags, self._places.poses
        located = tags.located(seen.id, poses, among)
        if located is None:
            self.ambiguous += any(view.tag == seen.id and view.keyframe in among for view in tags.views)
            return None
        known, keyframe = located
        # T_place_rect = T_place_tag exp(e1) exp(-e2) T_rect_tag^-1, both errors in the tag's axes.
        T_place_rect = se3.inverse(poses[keyframe]) @ known.T @ se3.inverse(seen.T_rect_tag)
        A = se3.adjoint(seen.T_rect_tag)
        covariance = A @ (known.covariance + in_tag_axes(seen)) @ A.T
        return Recognition(keyframe, T_place_rect, covariance, CORNERS_SEEN, CORNERS_SEEN, 1, by_tag=True)

    def views(self, seen: Sequence[TagPose], keyframe: int) -> list[TagView]:
        """Return the tags that a keyframe (id) shows, as views for the map."""
        return [TagView(keyframe, tag.id, tag.T_rect_tag, in_tag_axes(tag)) for tag in seen]
