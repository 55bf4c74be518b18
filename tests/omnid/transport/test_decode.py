"""Decoded messages of a robot, for subscribers and readers of recordings."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.transport import codec, map_codec
from omnid.transport.decode import decode_cloud, decode_diagnostics, decode_map, decode_pose
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus


def test_decodes_a_pose_with_its_attachment() -> None:
    T = se3.transform(se3.rotation_exp([0.0, 0.0, 0.5]), [1.0, 2.0, 3.0])
    payload = codec.odometry_cdr(5, T, 2.0 * np.eye(6), np.arange(6.0), np.eye(6))
    pose = decode_pose(payload, PoseAttachment(7, "degraded", 2, 30, 40, 9).to_bytes(), received_ns=11)
    assert (pose.x_m, pose.y_m, pose.z_m, pose.state) == (1.0, 2.0, 3.0, "degraded")
    assert pose.yaw_rad == pytest.approx(0.5) and pose.received_ns == 11
    assert pose.attachment == PoseAttachment(7, "degraded", 2, 30, 40, 9)
    np.testing.assert_array_equal(pose.covariance, 2.0 * np.eye(6))
    np.testing.assert_array_equal(pose.velocity, np.arange(6.0))
    assert decode_pose(payload, b"").state == "unknown"


def test_decodes_diagnostics_clouds_and_maps() -> None:
    report = decode_diagnostics(
        codec.diagnostics_cdr(5, [DiagnosticStatus("a", 1, "so so", {"k": "v"}), DiagnosticStatus("b", 0, "", {})])
    )
    assert report.stamp_ns == 5 and [status.name for status in report.statuses] == ["a", "b"]
    assert (report.value("a", "k"), report.value("b", "k"), report.value("c", "k")) == ("v", "", "")
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    cloud = decode_cloud(map_codec.point_cloud_cdr(6, "odom", points, np.arange(50.0)))
    assert (cloud.stamp_ns, cloud.frame) == (6, "odom")
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(cloud.confidence, np.arange(50.0))
    cells = np.arange(-1, 11, dtype=np.int8).reshape(3, 4)
    grid = decode_map(map_codec.grid_cdr(7, "odom", cells, 0.5, (-2.0, 1.0)))
    assert (grid.stamp_ns, grid.frame, grid.cell_m, grid.corner) == (7, "odom", 0.5, (-2.0, 1.0))
    np.testing.assert_array_equal(grid.cells, cells)
