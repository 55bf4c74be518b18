"""A frame computes its disparities when they are read, and keeps a list of them when it is packed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.stereo_frame import StereoFrame
from tests.omnid.core.scenery import texture, wrapped

SHAPE = (20, 120)


def test_disparities_are_computed_for_the_motion_of_the_frame() -> None:
    asked = list[Exposure | None]()

    def disparities(exposure: Exposure | None) -> NDArray[np.float32]:
        asked.append(exposure)
        return np.full(SHAPE, 3.0, np.float32)

    panorama = wrapped(texture(1, SHAPE))
    frame = StereoFrame(1, panorama, panorama, disparities, np.ones(SHAPE, bool))
    assert asked == [] and (frame.disparity == 3).all() and asked == [None]


def test_a_packed_frame_has_the_same_disparities_in_less_memory() -> None:
    image = np.full(SHAPE, np.nan, np.float32)
    image[3, 5], image[19, 119] = 2.5, 7.0
    panorama = wrapped(texture(1, SHAPE))
    frame = StereoFrame(1, panorama, panorama, image, np.ones(SHAPE, bool))
    packed = frame.packed()
    assert np.array_equal(packed.disparity, image, equal_nan=True) and packed.disparity is not image
    assert callable(packed.disparities) and packed.lower is frame.lower
    again = replace(packed, seq=2).packed()
    assert np.array_equal(again.disparity, image, equal_nan=True)
