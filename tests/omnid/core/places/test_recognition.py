"""A place is recognised at any heading with an honest covariance, and no other place is taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.features import describe
from omnid.core.places.recognition import recognise
from tests.omnid.core.scenery import RenderedCameras, motion_errors
from tests.simulation import corridor
from tests.simulation.paths import planar_poses

YAWS = np.array([0.0, 2.5, -1.0])
POSES = planar_poses(np.array([[0.0, 0], [0.3, 0.2], [-0.25, -0.2]]), YAWS)


@pytest.fixture(scope="module")
def frames(cameras: RenderedCameras) -> list[StereoFrame]:
    return [cameras.frame(10 + k, T) for k, T in enumerate(POSES)]


@pytest.mark.parametrize("other", [1, 2])
def test_a_place_is_recognised_aside_and_turned(
    cameras: RenderedCameras, frames: list[StereoFrame], other: int
) -> None:
    there, here = describe(frames[0]), describe(frames[other])
    found = recognise(here, there, 7, float(YAWS[other]), cameras.model)
    assert found is not None and found.id == 7 and found.inliers >= 20 and found.sectors >= 4
    distance, angle = motion_errors(found.T_place_rect, se3.inverse(POSES[0]) @ POSES[other])
    sigmas = np.sqrt(np.diag(found.covariance))
    assert distance < 0.02 and angle < 0.01
    assert distance < 4 * np.linalg.norm(sigmas[:3]) and angle < 4 * np.linalg.norm(sigmas[3:])
    assert sigmas.max() < 0.02


def test_another_place_and_darkness_are_not_recognised(cameras: RenderedCameras, frames: list[StereoFrame]) -> None:
    there = describe(frames[0])
    elsewhere = describe(replace(cameras, scene=corridor(7)).frame(3, POSES[0]))
    found = recognise(elsewhere, there, 0, 0.0, cameras.model)
    assert found is None or found.inliers < 15
    nothing = describe(cameras.darkness(4))
    assert len(nothing.views) == 0 and recognise(nothing, there, 0, 0.0, cameras.model) is None
