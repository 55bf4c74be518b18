"""AprilTags of a map: names and sizes, their views from keyframes, and their poses in the map."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.tags import TagEstimate, fused

Array = NDArray[np.float64]

MAX_VIEWS: Final = 24  # Most views of a tag that are kept, the most certain ones. By judgement; not measured.
MOST_REJECTED: Final = 0.25  # share of the views of a tag that may contradict the others, because it hangs in one place


@dataclass(frozen=True, slots=True)
class MapTag:
    """A tag that the map knows, or is to know."""

    id: int
    name: str
    size_m: float  # edge of its black square


@dataclass(frozen=True, slots=True, eq=False)
class TagView:
    """Pose of a tag as a keyframe saw it; covariance (6, 6) [t; r] in the tag's axes: T exp(xi)."""

    keyframe: int  # id
    tag: int  # id
    T_rect_tag: Array  # (4, 4)
    covariance: Array


class MapTags:
    """Tags by id, and their views from keyframes; at most MAX_VIEWS of each."""

    def __init__(self) -> None:
        self.known: dict[int, MapTag] = {}
        self.views: list[TagView] = []
        self.forgotten = 0  # views, because others were more certain

    def __bool__(self) -> bool:
        return bool(self.known)

    def add(self, views: Iterable[TagView]) -> None:
        """Add views of known tags; the least certain one of a tag with too many is forgotten."""
        for new in views:
            self.views.append(new)
            same = [view for view in self.views if view.tag == new.tag]
            if len(same) > MAX_VIEWS:
                worst = max(same, key=_uncertainty)
                self.views = [view for view in self.views if view is not worst]
                self.forgotten += 1

    def move_views(self, keyframe: int, to: int | None, T_to_keyframe: Array, covariance: Array) -> None:
        """Give the views of a keyframe that leaves the map to another one, or to none.

        covariance (6, 6) [t; r] of T_to_keyframe, in the axes of the keyframe that leaves.
        """
        leaving = [view for view in self.views if view.keyframe == keyframe]
        self.views = [view for view in self.views if view.keyframe != keyframe]
        if to is None:
            return
        for view in leaving:
            A = se3.adjoint(se3.inverse(view.T_rect_tag))
            self.add([TagView(to, view.tag, T_to_keyframe @ view.T_rect_tag, view.covariance + A @ covariance @ A.T)])

    def part(self, ids: Container[int]) -> MapTags:
        """Return all tags with their views from some keyframes."""
        part = MapTags()
        part.known, part.forgotten = dict(self.known), self.forgotten
        part.views = [view for view in self.views if view.keyframe in ids]
        return part

    def require_same_sizes(self, other: MapTags) -> None:
        """Raise ValueError where a tag has another size in another map: its views there are of another scale."""
        for id in sorted(self.known.keys() & other.known.keys()):
            here, there = self.known[id], other.known[id]
            if here.size_m != there.size_m:
                raise ValueError(
                    f"tag {id} ({there.name}) has an edge of {there.size_m:g} m, but of {here.size_m:g} m before"
                )

    def join(self, other: MapTags, renumbered: Callable[[int], int]) -> None:
        """Add the tags of another map, whose keyframes have got new ids. Raises as `require_same_sizes` does."""
        self.require_same_sizes(other)
        self.known = other.known | self.known
        self.add(TagView(renumbered(view.keyframe), view.tag, view.T_rect_tag, view.covariance) for view in other.views)

    def located(self, tag: int, poses: Mapping[int, Array], among: Container[int]) -> tuple[TagEstimate, int] | None:
        """Return the pose of a tag in the map, by its views from some keyframes, and the keyframe of the best view.

        poses: T_map_rect (4, 4) by keyframe. None without a view, or where the views show it in several places.
        """
        views = [view for view in self.views if view.tag == tag and view.keyframe in among]
        if not views:
            return None
        found = fused([poses[view.keyframe] @ view.T_rect_tag for view in views], [view.covariance for view in views])
        if found.rejected > MOST_REJECTED * len(views):
            return None
        return found, min(views, key=_uncertainty).keyframe

    def all_located(self, poses: Mapping[int, Array]) -> dict[int, TagEstimate]:
        """Return the poses in the map of the tags that were seen, by their ids."""
        found = {tag: self.located(tag, poses, poses) for tag in sorted(self.known)}
        return {tag: one[0] for tag, one in found.items() if one is not None}


def _uncertainty(view: TagView) -> float:
    return float(np.trace(view.covariance))
