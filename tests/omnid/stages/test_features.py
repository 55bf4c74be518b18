"""Features that the odometry publishes for the viewer."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from omnid.config import Config
from omnid.messages import OdometryUpdate
from omnid.runs.replay import ReplayOptions, run_log
from tests.conftest import PAIRS


class Watcher:
    """Sink that keeps all poses of a run."""

    def __init__(self) -> None:
        self.poses: list[OdometryUpdate] = []

    def process(self, message: object) -> None:
        if isinstance(message, OdometryUpdate):
            self.poses.append(message)


@pytest.fixture(scope="module")
def poses(scene: Path) -> list[OdometryUpdate]:
    watcher = Watcher()
    options = ReplayOptions(rig=scene / "rig.toml", inline=True, observer=lambda place, telemetry: watcher)
    assert run_log(scene / "log.mcap", Config(), options).counters.poses == PAIRS
    return watcher.poses


def test_the_first_pair_has_new_features_only(poses: list[OdometryUpdate]) -> None:
    first, *others = poses
    assert len(others) == PAIRS - 1
    assert len(first.features.new) >= first.tracks > 50  # a few are too far away to be located
    assert not len(first.features.inliers) and not len(first.features.rejected)


def test_inliers_and_rejected_features_are_different_ones(poses: list[OdometryUpdate]) -> None:
    gaps: list[float] = []
    for odometry in poses[1:]:
        seen = odometry.features
        assert len(seen.inliers) >= odometry.inliers and len(seen.rejected) <= odometry.tracks
        gaps += np.linalg.norm(seen.rejected[:, None] - seen.inliers[None], axis=2).min(axis=1).tolist()
    assert gaps and np.mean(np.array(gaps) < 1) < 0.2  # px; a wrongly tracked feature may end on another


def test_features_are_pixels_of_the_lower_panorama(poses: list[OdometryUpdate]) -> None:
    for odometry in poses:
        height, width = odometry.depth.panoramas.visible.shape
        for pixels in (odometry.features.inliers, odometry.features.rejected, odometry.features.new):
            assert pixels.shape[1] == 2 and (pixels >= -1).all() and (pixels <= [width, height]).all()


def test_new_features_are_inliers_of_the_keyframe_before(poses: list[OdometryUpdate]) -> None:
    for before, odometry in pairwise(poses):
        new = {tuple(pixel) for pixel in odometry.features.new}
        assert new <= {tuple(pixel) for pixel in odometry.features.inliers}
        assert not new or (before.is_keyframe and before.features.new.size == 0)
    assert any(len(odometry.features.new) for odometry in poses[1:])
