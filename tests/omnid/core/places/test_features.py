"""Features of a place: corners of known depth, with descriptors that a turn of the robot does not change."""

from __future__ import annotations

import numpy as np

from omnid.core.places.features import FEATURES, describe
from tests.omnid.core.scenery import RenderedCameras


def test_features_have_known_depths_and_are_bounded(cameras: RenderedCameras) -> None:
    frame = cameras.frame(1, np.eye(4))
    found = describe(frame)
    assert 50 < len(found.views) == len(found.descriptors) <= FEATURES and found.descriptors.shape[1:] == (128,)
    assert np.isfinite(found.views).all() and (found.views[:, 2] > found.views[:, 1]).all()
    columns, rows = np.rint(found.views[:, :2]).astype(int).T
    assert frame.usable[rows, columns % frame.lower.width].all()


def test_nothing_is_described_in_the_dark(cameras: RenderedCameras) -> None:
    assert len(describe(cameras.darkness(1)).views) == 0
