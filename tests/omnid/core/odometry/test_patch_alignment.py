"""Patches are located where they are, or refused."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder
from omnid.core.odometry.patch_alignment import align, align_rows, view_noise
from omnid.core.odometry.patch_fit import TEMPLATE_PX
from omnid.core.types.stereo_model import StereoModel
from tests.omnid.core.scenery import texture, wrapped

Array = NDArray[np.float64]

HALF = TEMPLATE_PX // 2


def test_patches_far_from_where_they_were_predicted_are_refused() -> None:
    image = wrapped(texture(3))
    pixels = np.array([[100, 50], [200, 60]])
    templates = np.array(
        [
            image.panorama[row - HALF : row + HALF + 1, column - HALF : column + HALF + 1]
            for column, row in pixels.tolist()
        ]
    )
    one = np.zeros(2, np.intp)
    near, far = (align(templates, image, pixels + offset, one) for offset in (0.4, 5.0))
    assert near.found.all() and not far.found.any()


def test_rows_in_the_upper_panorama_are_found_where_its_exposure_differs() -> None:
    lower = texture(5)
    model = StereoModel(Cylinder(lower.shape[1], lower.shape[0], 60.0), 0.2)
    upper = np.clip(np.roll(lower, 7, axis=0) * 0.6 + 20, 0, 255).astype(np.uint8)
    points = np.array([[60.0, 40.0], [200.0, 60.0], [330.0, 52.0], [410.0, 70.0]])
    guess = points + np.array([[0, 7.6], [0, 6.5], [0, 7.3], [0, np.nan]])
    slopes = np.zeros((4, 2))
    rows, variance = align_rows((wrapped(lower), wrapped(upper)), points, guess, slopes, model)
    # The rolled image is a cylinder, not a plane: that is 0.03 px at the window's sides.
    np.testing.assert_allclose(rows[:3], points[:3, 1] + 7, atol=0.03)
    assert np.isnan(rows[3]) and (variance[:3] > 0).all()
    aside = wrapped(np.roll(upper, 1, axis=1))
    assert np.isnan(align_rows((wrapped(lower), aside), points, guess, slopes, model)[0]).all()


def test_the_noise_of_the_upper_row_is_that_of_the_lower_row_and_of_the_disparity() -> None:
    of_pixels = np.array([[[0.04, 0.01], [0.01, 0.09]]])
    noise = view_noise(of_pixels, np.array([0.25]))
    np.testing.assert_allclose(noise[0], [[0.04, 0.01, 0.01], [0.01, 0.09, 0.09], [0.01, 0.09, 0.34]])
