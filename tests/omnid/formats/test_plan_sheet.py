"""The sheet of a plan: its size is bounded, and few points far away do not shrink the rest."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.formats.plan_view import plan_view
from tests.omnid.formats.test_plan_view import MARGIN_PX, NO_PATH, box, dark_centre, points


@pytest.mark.parametrize("extent_m", [0.01, 3.0, 250.0, 1e6, 1e9])
@pytest.mark.parametrize("side_px", [1, 300, 1400, 10**6])
def test_size_is_bounded_for_any_extent(extent_m: float, side_px: int) -> None:
    for shape in ([1.0, 0.0], [0.0, 1.0], [1.0, -0.7]):
        path = np.linspace(0, extent_m, 30)[:, None] * shape
        image = plan_view(points(box(0, 0)), path, max_side_px=side_px)
        assert max(image.shape) <= max(256, min(side_px, 2000)) and min(image.shape[:2]) > 2 * MARGIN_PX + 10


def test_a_few_far_points_do_not_shrink_the_rest() -> None:
    room = np.vstack([box(x, y) for x in np.arange(-3, 3, 0.4) for y in (-3, 3)])
    far = np.array([[500.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [3e38, 0.0, 0.0]])
    clean, littered = (plan_view(points(cloud), NO_PATH) for cloud in (room, np.vstack([room, far])))
    assert abs(clean.shape[1] - littered.shape[1]) < 9
    assert dark_centre(littered) == pytest.approx(dark_centre(clean), abs=0.02)
