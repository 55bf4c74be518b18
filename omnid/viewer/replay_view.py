"""View of a replay: draws what the stages compute from a log of images."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from calib import se3
from omnid.core.frames import base_pose, in_outer_axes, of_base
from omnid.core.mapping.keyframe_grid import KeyframeScans
from omnid.core.mapping.range_scan import azimuths
from omnid.engine.telemetry import Telemetry
from omnid.messages import MapUpdate, ObstacleRing, OdometryUpdate, PlaceUpdate
from omnid.sinks.encoder import Outgoing
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry
from omnid.transport.decode import Cloud, Pose
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.scan_codec import Scan
from omnid.viewer.image_encoding import jpeg
from omnid.viewer.rerun_scene import RerunScene
from omnid.viewer.status_plots import STAGES
from omnid.viewer.style import depth_image

MAP_EVERY_S: Final = 2.0


class ReplayView:
    """A sink of a run that draws poses, frames and maps."""

    def __init__(self, scene: RerunScene, front_end: FrontEnd, telemetry: Telemetry) -> None:
        self._scene, self._geometry, self._dense = scene, front_end.geometry, front_end.dense
        self._latencies = StageLatencies(telemetry)
        self._drawn: KeyframeScans | None = None  # keyframes that were drawn last

    def process(self, message: Outgoing) -> None:
        """Draw a message; velocity commands are not drawn."""
        if isinstance(message, OdometryUpdate):
            self._odometry(message)
        elif isinstance(message, MapUpdate):
            self._map(message)
        elif isinstance(message, PlaceUpdate):
            self._places(message)
        elif isinstance(message, ObstacleRing):
            self._scene.scan(
                Scan(message.stamp_ns, "base_link", azimuths(), message.ranges_m, message.sigma_m, math.inf)
            )

    def _odometry(self, odometry: OdometryUpdate) -> None:
        scene = self._scene
        if not scene.poses:
            scene.rig(self._geometry.rig.T_base_rig)
        scene.pose(pose_of(odometry, self._geometry))
        for stage, mean_ms in self._latencies():
            scene.latency(odometry.stamp_ns, (stage,), mean_ms)
        if scene.wants("frame"):
            self._frame(odometry)

    def _frame(self, odometry: OdometryUpdate) -> None:
        scene, depth, stamp_ns = self._scene, self._dense.of(odometry.depth), odometry.stamp_ns
        scene.panorama(stamp_ns, jpeg(odometry.depth.panoramas.lower.panorama))
        scene.features(stamp_ns, odometry.features)
        focal_baseline = self._geometry.cylinder.focal_px * self._geometry.rig.baseline_m
        scene.depth(stamp_ns, depth_image(depth.disparity, focal_baseline), depth.points)

    def _places(self, update: PlaceUpdate) -> None:
        """Plot the correction, and draw keyframes and loops where the map has them now."""
        T_base_rig = self._geometry.rig.T_base_rig
        T_map_odom, _ = base_pose(update.T_map_odom, update.covariance, T_base_rig)
        self._scene.correction(update.stamp_ns, T_map_odom)
        keyframes = update.scans
        if keyframes is None or keyframes is self._drawn or not self._scene.wants("places"):
            return
        self._drawn = keyframes
        to_odom = se3.inverse(T_map_odom) @ T_base_rig @ self._geometry.T_rig_rect
        at = dict(zip(keyframes.scans, (to_odom @ keyframes.T_map_rect)[:, :3, 3], strict=True))
        loops = [(at[a], at[b]) for a, b in keyframes.loops if a in at and b in at]
        self._scene.places(
            update.stamp_ns, np.array(list(at.values())).reshape(-1, 3), np.array(loops).reshape(-1, 2, 3)
        )

    def _map(self, update: MapUpdate) -> None:
        points = se3.apply(self._geometry.rig.T_base_rig, update.points.xyz.astype(float)).astype(np.float32)
        self._scene.cloud(Cloud(update.stamp_ns, "odom", points, update.points.confidence))


def pose_of(odometry: OdometryUpdate, geometry: Geometry) -> Pose:
    """Return the pose of the base, as subscribers of the bus receive it."""
    attachment = PoseAttachment(
        odometry.seq, odometry.state, resets=odometry.reset_counter, inliers=odometry.inliers, tracked=odometry.tracks
    )
    base = of_base(odometry, geometry.rig.T_base_rig)
    in_odom_axes = base._replace(covariance=in_outer_axes(base.T_odom_base, base.covariance))
    return Pose(odometry.stamp_ns, *in_odom_axes, attachment, odometry.stamp_ns)


class StageLatencies:
    """Mean processing time of each stage since the previous call."""

    def __init__(self, telemetry: Telemetry) -> None:
        self._telemetry = telemetry
        self._before: dict[str, tuple[int, float]] = {}

    def __call__(self) -> Iterator[tuple[str, float]]:
        """Yield name and mean [ms] of the stages that have processed messages since the previous call."""
        for stage in self._telemetry.stages:
            count, mean_s = stage.wall.count, stage.wall.mean_s
            total_s = count * mean_s if count else 0.0
            before, before_s = self._before.get(stage.name, (0, 0.0))
            self._before[stage.name] = count, total_s
            if count > before and stage.name in STAGES:
                yield stage.name, 1e3 * (total_s - before_s) / (count - before)
