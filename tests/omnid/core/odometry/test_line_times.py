"""Lines that are read one after another, by residuals that are computed: their time, and landmarks that are few."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.line_times import LineTimes, RawImage, ReadOut
from omnid.core.odometry.local_map import Keyframe, LocalMap
from omnid.core.odometry.tracking import KltSettings
from omnid.core.stereo.triangulation import view
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

MODEL = StereoModel(Cylinder(1304, 383, 128.5), 0.2, sigma_px=0.2)
VELOCITY = np.array([1.0, 0.2, 0.0, 0.0, 0.0, 0.5])
DT_S = 0.1
SIZE = (1304, 383)  # columns and rows of a raw image that is the panorama itself
COLUMN, ROW = np.meshgrid(np.arange(1304, dtype=np.float32), np.arange(383, dtype=np.float32))


def seen_at(points: Array, T_odom_rect: Array, read_s: float) -> Array:
    """Return the views (N, 3) of points in odom by cameras that read their rows within a time."""
    views = []
    for row in (1, 2):
        late_s = np.zeros(len(points))
        for _ in range(3):
            poses = T_odom_rect @ se3.exp(late_s[:, None] * VELOCITY)
            moved = se3.apply(se3.inverse(poses), points[:, None])[:, 0]
            seen = view(moved, MODEL.cylinder, MODEL.baseline_m)
            late_s = read_s * (seen[:, row] / SIZE[1] - 0.5)
        views.append(seen)
    return np.column_stack([views[0][:, :2], views[1][:, 2]])


def pooled(read_s: float, landmarks: int, pairs: int = 15) -> ReadOut | None:
    """Return what is found along a drive past landmarks that the first pair shows."""
    rng, lines = np.random.default_rng(3), LineTimes(MODEL, (RawImage(COLUMN, ROW, SIZE), RawImage(COLUMN, ROW, SIZE)))
    azimuth, r = rng.uniform(-np.pi, np.pi, landmarks), rng.uniform(1.0, 2.5, landmarks)
    points = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(-0.6, 0.4, landmarks)])
    local_map = LocalMap(MODEL, KltSettings())
    first = seen_at(points, np.eye(4), read_s) + rng.normal(0, 0.05, (landmarks, 3))
    lower: Any = SimpleNamespace()
    local_map.add_keyframe(Keyframe(0, lower, np.eye(4), np.zeros((6, 6))), first, np.zeros((landmarks, 2)))
    for seq in range(1, pairs):
        T = se3.exp(DT_S * seq * VELOCITY)
        views = seen_at(points, T, read_s) + rng.normal(0, 0.05, (landmarks, 3))
        rows, variance = np.arange(landmarks), np.full(landmarks, 0.01)
        estimate = PoseEstimate(T, np.eye(6), landmarks, landmarks, landmarks, rows, views, views[:, :2], variance)
        lines.add(seq, estimate, local_map, VELOCITY, DT_S)
    return lines.likeliest()


@pytest.mark.parametrize("read_s", [0.05, -0.06])
def test_the_time_in_which_both_cameras_read_their_rows_is_measured(read_s: float) -> None:
    found = pooled(read_s, 200)
    assert found is not None and found.cameras == (0, 1) and found.gain > 0
    assert found.time_s == pytest.approx(read_s, rel=0.2)


@pytest.mark.parametrize("landmarks", [1, 2, 200])
def test_images_of_one_instant_have_none(landmarks: int) -> None:
    """Also of keyframes with so few landmarks that they do not determine a pose."""
    assert pooled(0.0, landmarks) is None
