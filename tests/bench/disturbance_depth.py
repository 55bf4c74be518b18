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
from omnid.engine.telemetry import Telemetry
from omnid.messages import ObstacleRing, OdometryUpdate
from omnid.sinks.encoder import Outgoing
from omnid.stages.front_end import FrontEnd
from tests.bench.log_rings import Counts, Segments, compare
from tests.simulation import Scene

Array = NDArray[np.float64]

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
    counts: Counts = field(default_factory=Counts)
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
        sectors = sum(self.counts.of["all|all"].values())
        missed = 100 * self.counts.of["all|all"]["missed"] / sectors
        return missed, 100 * self.counts.false_alarms["all|all"] / max(1, self.counts.ranges["all|all"])

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
        T = self.T_world_rig[ring.stamp_ns] @ se3.inverse(self.rig.T_base_rig)
        segments = Segments(self.scene.rectangles, self.config.obstacles.ring.heights_m)
        yaw = float(np.arctan2(T[1, 0], T[0, 0]))
        compare(ring, segments.ring(float(T[0, 3]), float(T[1, 3]), yaw), "", self.counts)


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
