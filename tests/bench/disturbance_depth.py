"""Depth and obstacles of one replay against the true world: what `python -m tests.bench.disturbances` shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.rig import Rig
from omnid.config import Config
from omnid.core.mapping.range_scan import azimuths
from omnid.engine.telemetry import Telemetry
from omnid.messages import ObstacleRing, OdometryUpdate
from omnid.simulation.clearance import footprints, ranges_m
from omnid.sinks.encoder import Outgoing
from omnid.stages.front_end import FrontEnd
from tests.simulation import Scene

Array = NDArray[np.float64]

NEAREST_M, FARTHEST_M = 0.3, 4.0  # of the obstacles that count
POINTS: Final = 2000  # of a keyframe, evenly chosen
SIGMAS: Final = 3.0  # a point whose range is wrong by more of its own, and by
WRONG_PART: Final = 0.05  # this part of the range, is wrong


@dataclass(slots=True)
class DepthMeasure:
    """Observer of a run: errors of the dense points of its keyframes, and of its rings of obstacles."""

    scene: Scene
    T_world_rig: Mapping[int, Array]  # true pose (4, 4) by stamp
    rig: Rig
    config: Config
    errors: list[Array] = field(default_factory=list)  # of ranges, relative
    wrong: list[NDArray[np.bool_]] = field(default_factory=list)
    sectors: list[tuple[int, int, int, int]] = field(default_factory=list)  # see _compare_ring
    _front_end: FrontEnd | None = None
    _rings: int = 0

    def __call__(self, front_end: FrontEnd, telemetry: Telemetry) -> DepthMeasure:
        """Return the sink of all messages of a run."""
        self._front_end = front_end
        return self

    def process(self, message: Outgoing) -> None:
        """Compare a message with the world."""
        if isinstance(message, OdometryUpdate) and message.is_keyframe:
            self._compare_points(message)
        if isinstance(message, ObstacleRing):
            self._rings += 1
            if self._rings > 1:  # the first ring has no votes
                self._compare_ring(message)

    @property
    def obstacle_shares(self) -> tuple[float, float]:
        """Missed sectors of those with an obstacle, and false alarms of the ranges, in per cent."""
        missed, near, false, told = np.sum(self.sectors, axis=0)
        return 100 * missed / near, 100 * false / max(1, told)

    def _compare_points(self, update: OdometryUpdate) -> None:
        assert self._front_end is not None
        dense = self._front_end.dense.of(update.depth)
        chosen = np.linspace(0, len(dense.points) - 1, min(POINTS, len(dense.points))).astype(int)
        # 1. Rays from the lower viewpoint, in the world.
        T = self.T_world_rig[update.stamp_ns]
        origin = se3.inverse(self.rig.lower.T_cam_rig)[:3, 3]
        rays = dense.points[chosen] - origin
        found_m = np.linalg.norm(rays, axis=1)
        true_m = true_ranges_m(self.scene, se3.apply(T, origin[None])[0], rays / found_m[:, None] @ T[:3, :3].T)
        # 2. Errors of the ranges along them.
        error_m = found_m - true_m
        limit_m = np.maximum(SIGMAS * np.sqrt(dense.variance_m2[chosen]), WRONG_PART * true_m)
        self.errors.append(error_m / true_m)
        self.wrong.append(np.abs(error_m) > limit_m)

    def _compare_ring(self, ring: ObstacleRing) -> None:
        """Count sectors: free or with a range beyond the true obstacle; with one; with a range before it; with any."""
        T = self.T_world_rig[ring.stamp_ns] @ se3.inverse(self.rig.T_base_rig)
        segments = footprints(self.scene.rectangles, self.config.obstacles.ring.heights_m[1])
        rays = (azimuths()[:, None] + se3.yaw(T) + np.radians([-1 / 3, 0.0, 1 / 3])).ravel()
        true_m = ranges_m(segments, (float(T[0, 3]), float(T[1, 3])), rays).reshape(-1, 3).min(axis=1)
        limit_m = 0.1 + 0.03 * np.where(np.isfinite(true_m), true_m, 0.0) ** 2  # three sigma of stereo
        found_m = np.where(np.isnan(ring.ranges_m), np.inf, ring.ranges_m)
        # An edge may be two sectors off.
        around, seen = (np.min([np.roll(part, by) for by in range(-2, 3)], axis=0) for part in (true_m, found_m))
        near = (true_m > NEAREST_M) & (true_m < FARTHEST_M)
        is_unknown = np.isnan(ring.ranges_m) & (ring.free_m <= true_m + limit_m)
        missed = near & (seen > true_m + limit_m) & ~is_unknown
        told = near & np.isfinite(ring.ranges_m)
        false = told & (ring.ranges_m < around - 0.1 - 0.03 * np.minimum(around, FARTHEST_M) ** 2)
        self.sectors.append(tuple(int(part.sum()) for part in (missed, near, false, told)))  # type: ignore[arg-type]


def true_ranges_m(scene: Scene, origin: Array, directions: Array) -> Array:
    """Return the distances (N,) [m] from origin (3,) to the nearest surface along unit vectors (N, 3); inf: none."""
    nearest = np.full(len(directions), np.inf)
    for face in scene.rectangles:
        with np.errstate(divide="ignore", invalid="ignore"):
            range_m = ((face.origin - origin) @ face.normal) / (directions @ face.normal)
            at = origin + range_m[:, None] * directions - face.origin
            u, v = at @ face.edge_u / face.width_m**2, at @ face.edge_v / face.height_m**2
        hit = (range_m > 0) & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        nearest = np.where(hit, np.minimum(nearest, range_m), nearest)
    return nearest
