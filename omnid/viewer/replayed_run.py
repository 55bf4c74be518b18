"""A log of images, run through the daemon's own stages and shown pair by pair."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib import se3
from omnid.engine.telemetry import Telemetry
from omnid.messages import MapUpdate, OdometryUpdate
from omnid.sinks.encoder import Outgoing
from omnid.stages.geometry import Geometry
from omnid.stages.odometry import of_base
from omnid.transport.decode import Cloud, Pose
from omnid.transport.pose_attachment import PoseAttachment
from omnid.viewer.image_encoding import jpeg
from omnid.viewer.rerun_scene import RerunScene
from omnid.viewer.status_plots import STAGES
from omnid.viewer.style import depth_image

MAP_EVERY_S: Final = 2.0


class ReplayedRunView:
    """A sink of all that a run has to say, which it draws."""

    def __init__(self, board: RerunScene, place: Geometry, telemetry: Telemetry) -> None:
        self._board, self._place = board, place
        self._latencies = Latencies(telemetry)

    def process(self, message: Outgoing) -> None:
        """Draws what there is to see of a message; commands to the wheels are none."""
        if isinstance(message, OdometryUpdate):
            self._odometry(message)
        elif isinstance(message, MapUpdate):
            self._map(message)

    def _odometry(self, odometry: OdometryUpdate) -> None:
        board, stamp_ns = self._board, odometry.stamp_ns
        if not board.poses:
            board.rig(self._place.rig.T_base_rig)
        board.pose(pose_of(odometry, self._place))
        for stage, mean_ms in self._latencies():
            board.latency(stamp_ns, (stage,), mean_ms)
        if board.wants("sight"):
            self._sight(odometry)

    def _sight(self, odometry: OdometryUpdate) -> None:
        board, depth, stamp_ns = self._board, odometry.depth, odometry.stamp_ns
        board.panorama(stamp_ns, jpeg(depth.panoramas.lower.panorama))
        board.features(stamp_ns, odometry.features)
        focal_baseline = self._place.cylinder.focal_px * self._place.rig.baseline_m
        board.depth(stamp_ns, depth_image(depth.disparity, focal_baseline), depth.points)

    def _map(self, update: MapUpdate) -> None:
        points = se3.apply(self._place.rig.T_base_rig, update.points.xyz.astype(float)).astype(np.float32)
        self._board.cloud(Cloud(update.stamp_ns, "odom", points, update.points.confidence))


def pose_of(odometry: OdometryUpdate, place: Geometry) -> Pose:
    """The pose of the base, as the bus has it."""
    attachment = PoseAttachment(odometry.seq, odometry.state, odometry.reset_counter, odometry.inliers, odometry.tracks)
    return Pose(odometry.stamp_ns, *of_base(odometry, place.rig.T_base_rig), attachment, odometry.stamp_ns)


class Latencies:
    """What each stage took of late."""

    def __init__(self, telemetry: Telemetry) -> None:
        self._telemetry = telemetry
        self._before: dict[str, tuple[int, float]] = {}

    def __call__(self) -> Iterator[tuple[str, float]]:
        """Stages that have done something since the last time of asking, and the mean [ms] of that."""
        for stage in self._telemetry.stages:
            count, mean_s = stage.wall.count, stage.wall.mean_s
            total_s = count * mean_s if count else 0.0
            before, before_s = self._before.get(stage.name, (0, 0.0))
            self._before[stage.name] = count, total_s
            if count > before and stage.name in STAGES:
                yield stage.name, 1e3 * (total_s - before_s) / (count - before)
