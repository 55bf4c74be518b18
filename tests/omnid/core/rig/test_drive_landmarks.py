"""Landmarks of a drive are seen again in both panoramas where the path predicts them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.rig.drive_landmarks import DriveLandmarks, View
from omnid.core.stereo.triangulation import view
from omnid.core.types.stereo_model import StereoModel
from tests.omnid.core.scenery import RenderedCameras
from tests.simulation.paths import planar_poses

Array = NDArray[np.float64]
PATH = planar_poses(np.array([[0.1 * k, 0.02 * k] for k in range(6)]), np.linspace(0.0, 0.3, 6))


@pytest.fixture(scope="module")
def views(cameras: RenderedCameras) -> list[View]:
    frames = [cameras.frame(k, T) for k, T in enumerate(PATH)]
    poses = se3.inverse(PATH[0]) @ PATH
    return [View(f.lower, f.upper, f.usable, f.disparity, T) for f, T in zip(frames, poses, strict=True)]


def followed(views: list[View], model: StereoModel) -> DriveLandmarks:
    landmarks = DriveLandmarks(model)
    for seen in views:
        landmarks.add(seen)
    return landmarks


def test_landmarks_are_where_the_path_predicts_them(cameras: RenderedCameras, views: list[View]) -> None:
    found = followed(views, cameras.model).observations()
    T_rect_odom = se3.inverse(np.array([seen.T_odom_rect for seen in views]))
    points = se3.apply(T_rect_odom, found.points)[found.keyframe, found.landmark]
    predicted = view(points, cameras.model.cylinder, cameras.model.baseline_m)
    for camera, row in ((0, 1), (1, 2)):
        seen = found.camera == camera
        error = found.pixels[seen] - predicted[seen][:, [0, row]]
        error[:, 0] = cameras.model.cylinder.wrap(error[:, 0])
        assert np.median(np.abs(error)) < 0.15
        assert seen.sum() > 300
