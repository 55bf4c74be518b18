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
