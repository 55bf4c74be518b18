"""Comparison of a frame with keyframes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.features import describe
from omnid.core.places.place_comparison import VOTERS, votes
from omnid.core.places.place_map import PlaceFeatures
from tests.omnid.core.scenery import RenderedCameras
from tests.simulation import corridor
from tests.simulation.paths import planar_poses

YAWS = np.array([0.0, 2.5, -1.0])


POSES = planar_poses(np.array([[0.0, 0], [0.3, 0.2], [-0.25, -0.2]]), YAWS)


@pytest.fixture(scope="module")
def frames(cameras: RenderedCameras) -> list[StereoFrame]:
    return [cameras.frame(10 + k, T) for k, T in enumerate(POSES)]


def test_features_vote_for_their_place_and_the_turn(cameras: RenderedCameras, frames: list[StereoFrame]) -> None:
    """Half of the features are enough, as people may hide the others."""
    width, here = cameras.cylinder.width, describe(frames[0])
    for frame, yaw in zip(frames[1:], YAWS[1:], strict=True):
        found = describe(frame)
        half = found.views[:, 0] < width / 2
        count, turn = votes(PlaceFeatures(found.descriptors[half], found.views[half]), here, width)
        assert count >= 12 and abs(np.angle(np.exp(1j * (turn - yaw)))) < 0.3
    elsewhere = describe(replace(cameras, scene=corridor(7)).frame(3, POSES[0]))
    assert votes(here, here, width) == (VOTERS, pytest.approx(np.pi / 24)) and votes(elsewhere, here, width)[0] < 8
    nothing = describe(cameras.darkness(4))
    assert votes(nothing, here, width) == votes(here, nothing, width) == (0, 0.0)
