"""Compiled part of the patches of planes."""

from __future__ import annotations

import numpy as np

from omnid.core.odometry import plane_kernels
from omnid.core.odometry.patch_fit import TEMPLATE_PX


def test_a_place_that_is_unknown_has_no_template() -> None:
    image = np.full((60, 80), 90, np.uint8)
    centres, shift = np.array([[40.0, 30], [np.nan, 30], [40, 30], [1e9, 30], [0.0, 59]]), np.zeros((5, 2))
    shift[2, 1] = np.nan
    templates = np.empty((5, TEMPLATE_PX, TEMPLATE_PX), np.uint8)
    plane_kernels.sample(
        image,
        np.arange(5),
        centres,
        np.tile([2.0, 0, 0], (5, 1)),
        np.zeros((5, 2)),
        np.tile(np.eye(4), (5, 1, 1)),
        0.2,
        0.0,
        200.0,
        shift,
        templates,
    )
    assert (templates[[0, 4]] == 90).all() and not templates[1:4].any()


def test_the_border_of_an_image_is_repeated() -> None:
    image = np.random.default_rng(1).integers(0, 256, (40, 60), np.uint8)
    centres = np.array([[3.3, 20.1], [56.8, 20.6], [30.2, 2.4], [30.7, 37.9], [1.2, 38.5]])
    PAD = 40
    whole, padded = (np.empty((5, TEMPLATE_PX, TEMPLATE_PX), np.uint8) for _ in range(2))
    points, slopes = np.tile([2.0, 0.3, 0.1], (5, 1)), np.tile([0.05, -0.1], (5, 1))
    T, shift = np.tile(np.eye(4), (5, 1, 1)), np.full((5, 2), 0.2)
    T[:, :3, 3] = 0.1, -0.05, 0.02
    for source, at, templates in ((image, centres, whole), (np.pad(image, PAD, "edge"), centres + PAD, padded)):
        plane_kernels.sample(source, np.arange(5), at, points, slopes, T, 0.2, 0.0, 200.0, shift, templates)
    assert (np.abs(whole.astype(int) - padded) <= 1).all()  # float32 has fewer digits at larger places
    assert whole.std(axis=(1, 2)).min() > 10
