"""Places of a map: keyframes with what recognises them, their poses in the map, the links between them, and the rig."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
import scipy
from msgspec import Meta
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.mapping.scan_grid import KeyframeScans
from omnid.core.places.pose_graph import connected

Array = NDArray[np.float64]

NO_KEYFRAME: Final = -1  # Used in place of an id, because ids are never negative.
# A map is of the same rig where baseline, shift [m] and turn [rad] of the rectified frame differ by less than this: the
# rig may have been calibrated again.
BASELINE_RATIO, SHIFT_M, TURN_RAD = 0.01, 0.01, 0.02


@dataclass(frozen=True, slots=True)
class PlaceLimits:
    """Distance and number of the keyframes that stay."""

    keyframe_m: Annotated[
        float, Meta(ge=0.05, le=10), "distance after which a keyframe is kept for the recognition of the place, m"
    ] = 0.3
    keyframe_deg: Annotated[float, Meta(ge=1, le=180), "turn after which a keyframe is kept, deg"] = 15.0
    rate_hz: float = 5.0  # keyframes a second, at most: each is searched for in the map, in some 30 ms
    max_keyframes: Annotated[
        int,
        Meta(ge=2, le=100_000),
        "keyframes kept, of some 35 kB each in memory; more drop those that others are nearest to",
    ] = 2000


@dataclass(frozen=True, slots=True, eq=False)
class PlaceFeatures:
    """Features of a lower panorama whose depth is known: descriptors (N, 128), views (N, 3) [px].

    A view is column, lower row, upper row.
    """

    descriptors: NDArray[np.uint8]
    views: NDArray[np.float32]

    def first(self, count: int) -> PlaceFeatures:
        """Return the first of the features: the strongest ones, which are evenly spread."""
        return PlaceFeatures(self.descriptors[:count], self.views[:count])


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class PlaceKeyframe:
    """Evidence by which a place is recognised; the rectified frame is that of the lower panorama."""

    id: int
    session: int  # number of the run that added it: 0 for the first run of a map
    stamp_ns: int
    T_odom_rect: Array  # (4, 4) as odometry estimated it, in the odom of its session
    covariance: Array  # (6, 6) of it, [t; r] in the rectified frame
    thumbnail: NDArray[np.int8]  # (16, 128) the panorama's contrast, see features.py
    scan: NDArray[np.float16]  # (360,) m, nearest obstacle by azimuth from -pi on, NaN unknown
    free_m: NDArray[np.float16]  # (360,) in the same order, up to which floor was seen, see FreeRanges
    features: PlaceFeatures

    def relative_pose(self, T_odom_rect: Array, covariance: Array) -> tuple[Array, Array]:
        """Return T_keyframe_rect (4, 4) of a later pose of odometry with its covariance, and its own covariance (6, 6).

        Covariances grow along the path: it is what the later pose has beyond the keyframe. Its negative part, where the
        estimate of the later one became better, is left out.
        """
        T_keyframe_rect = se3.inverse(self.T_odom_rect) @ T_odom_rect
        A = se3.adjoint(se3.inverse(T_keyframe_rect))
        grown = covariance - A @ self.covariance @ A.T
        values, vectors = np.linalg.eigh((grown + grown.T) / 2)
        return T_keyframe_rect, np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """An edge of the pose graph: the pose of keyframe b in the frame of keyframe a, T_true = T_a_b exp(xi)."""

    a: int
    b: int
    T_a_b: Array  # (4, 4)
    covariance: Array  # (6, 6) of xi = [t; r]
    inliers: int = 0  # features that support a loop; 0: an edge of odometry

    @staticmethod
    def by_odometry(a: PlaceKeyframe, b: PlaceKeyframe) -> Link:
        """Return the edge between two keyframes as odometry measured it."""
        return Link(a.id, b.id, *a.relative_pose(b.T_odom_rect, b.covariance))

    @property
    def is_loop(self) -> bool:
        """True if the edge comes from a place that was recognised."""
        return self.inliers > 0

    def reversed(self) -> Link:
        """Return the same edge from b to a."""
        A = se3.adjoint(self.T_a_b)
        return Link(self.b, self.a, se3.inverse(self.T_a_b), A @ self.covariance @ A.T, self.inliers)

    def then(self, other: Link) -> Link:
        """Return the edge from a to the end of another one that starts at b."""
        A = se3.adjoint(se3.inverse(other.T_a_b))
        covariance = A @ self.covariance @ A.T + other.covariance
        weakest = min((n for n in (self.inliers, other.inliers) if n), default=0)
        return Link(self.a, other.b, self.T_a_b @ other.T_a_b, covariance, weakest)


class PlaceMap:
    """Keyframes by id with their poses T_map_rect, and the links between them; bounded in number."""

    def __init__(self, max_keyframes: int = 2000) -> None:
        """max_keyframes: bound that holds from the next keyframe on."""
        self.max_keyframes = max_keyframes
        self.keyframes: dict[int, PlaceKeyframe] = {}
        self.poses: dict[int, Array] = {}
        self.links: list[Link] = []
        self.dropped = 0  # keyframes, because the map was full

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def loops(self) -> int:
        """Number of links from places that were recognised."""
        return sum(link.is_loop for link in self.links)

    def positions(self, ids: Sequence[int]) -> Array:
        """Return the positions (N, 3) of keyframes in the map."""
        return np.array([self.poses[id][:3, 3] for id in ids]).reshape(-1, 3)

    def scans(self, ids: Sequence[int]) -> KeyframeScans:
        """Return the range scans of keyframes, in the order of their ids given."""
        shown = {id: self.keyframes[id] for id in ids}
        scans, free_m = ({id: getattr(each, of) for id, each in shown.items()} for of in ("scan", "free_m"))
        return KeyframeScans(scans, free_m, np.array([self.poses[id] for id in ids]).reshape(-1, 4, 4))

    def parts(self) -> list[list[int]]:
        """Return the ids of the keyframes that links join, part by part, the largest first, ids ascending.

        A run that extends a saved map begins a part of its own, and so does odometry after a gap of unknown motion. A
        place that is recognised in another part joins the two.
        """
        return connected(list(self.keyframes), [(link.a, link.b) for link in self.links])

    def add(self, keyframe: PlaceKeyframe, T_map_rect: Array, link: Link | None = None) -> None:
        """Add a keyframe with the link of odometry that leads to it; None where there is no such link.

        A full map drops the older one of the two keyframes that are nearest to each other.
        """
        self.keyframes[keyframe.id] = keyframe
        self.poses[keyframe.id] = T_map_rect
        if link is not None:
            self.links.append(link)
        while len(self) > max(2, self.max_keyframes):
            self.drop(self._most_crowded(keyframe.id))
            self.dropped += 1

    def drop(self, id: int) -> None:
        """Drop a keyframe; its links go on to its neighbour on the path: the next keyframe, else the one before."""
        # 1. The links of the keyframe, turned so that they begin at it, and the link to the neighbour (`bridge`).
        touching = [link for link in self.links if id in (link.a, link.b)]
        self.links = [link for link in self.links if id not in (link.a, link.b)]
        leaving = [link if link.a == id else link.reversed() for link in touching]
        bridge = min((link for link in leaving if not link.is_loop), key=lambda link: link.b <= id, default=None)
        # 2. Links of the other keyframes to the neighbour, of loops the two that are most certain.
        if bridge is not None:
            joined = [link.reversed().then(bridge) for link in leaving if link is not bridge and link.b != bridge.b]
            loops = sorted((link for link in joined if link.is_loop), key=lambda link: float(np.trace(link.covariance)))
            self.links += [
                link if link.a < link.b else link.reversed()
                for link in (*(link for link in joined if not link.is_loop), *loops[:2])
            ]
        # 3. The keyframe leaves the map.
        del self.keyframes[id], self.poses[id]

    def _most_crowded(self, newest: int) -> int:
        """Return the older one of the two keyframes that are nearest to each other, not the newest."""
        ids = [id for id in self.keyframes if id != newest]
        apart, neighbour = scipy.spatial.cKDTree(self.positions(ids)).query(self.positions(ids), k=2)
        nearest = int(apart[:, 1].argmin())
        # Where several are at one position, the second of them may be found first.
        return min(ids[nearest], *(ids[int(n)] for n in neighbour[nearest]))

    def part(self, ids: Iterable[int]) -> PlaceMap:
        """Return a map of some keyframes, and the links between them."""
        chosen = set(ids)
        part = PlaceMap(self.max_keyframes)
        part.keyframes = {id: keyframe for id, keyframe in self.keyframes.items() if id in chosen}
        part.poses = {id: self.poses[id] for id in part.keyframes}
        part.links = [link for link in self.links if link.a in chosen and link.b in chosen]
        part.dropped = self.dropped
        return part


@dataclass(frozen=True, slots=True, eq=False)
class PlaceRig:
    """The part of a rig on which a map depends: panoramas, baseline, frames of robot and rig, hash of its file."""

    cylinder: Cylinder
    baseline_m: float
    T_rig_rect: Array  # (4, 4) of the rectified frame, in which a map is kept
    T_base_rig: Array  # (4, 4)
    rig_hash: str  # hexadecimal

    @property
    def T_base_rect(self) -> Array:
        """Transform (4, 4) from the rectified frame to the robot's base, in whose axes a map is published."""
        return self.T_base_rig @ self.T_rig_rect

    def difference(self, other: PlaceRig) -> str:
        """Return in words why places seen by this rig cannot be compared with those of another; "" where they can."""
        if self.cylinder.width != other.cylinder.width:
            return f"panoramas of {self.cylinder.width} columns, not {other.cylinder.width}"
        if abs(self.baseline_m - other.baseline_m) > BASELINE_RATIO * other.baseline_m:
            return f"a baseline of {self.baseline_m:.4f} m, not {other.baseline_m:.4f} m"
        moved = se3.log(se3.inverse(self.T_rig_rect) @ other.T_rig_rect)
        shift_m, turn_rad = float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:]))
        if turn_rad <= TURN_RAD and shift_m <= SHIFT_M:
            return ""
        moved_words = f"{1e3 * shift_m:.0f} mm and {np.degrees(turn_rad):.1f} degrees"
        return f"viewpoints that lie otherwise in the rig, by {moved_words}"

    def adapt(self, places: PlaceMap, rig_of_map: PlaceRig) -> None:
        """Change the views of a map, in place, to those in the panoramas of this rig; its own rig has no difference.

        The horizon's row depends on the masks, which may have been found in the images of the run.
        """
        shift = np.float32(self.cylinder.row0 - rig_of_map.cylinder.row0)
        for keyframe in places.keyframes.values():
            keyframe.features.views[:, 1:] += shift
