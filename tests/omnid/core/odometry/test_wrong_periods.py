"""Landmarks that dense stereo puts one period of the texture too far away are left out of the map."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.odometry.wrong_periods import NEIGHBOURS, disparities_alike, has_wrong_period
from omnid.core.types.panorama import PaddedPanorama
from tests.omnid.core.scenery import texture, wrapped

Array = NDArray[np.float64]

PERIOD_PX, DISPARITY_PX = 24, 40
PIXEL = np.array([[100.0, 50.0]])
KNOWN = np.array([[90.0 + 3 * k, 40.0, 40.0 + DISPARITY_PX] for k in range(NEIGHBOURS)])


def pair(repeats: bool) -> tuple[PaddedPanorama, PaddedPanorama]:
    """Return panoramas of a wall whose texture repeats along columns, or not, DISPARITY_PX lower in the upper one."""
    image = texture(1, (192, 480))
    if repeats:
        image = np.tile(image[:PERIOD_PX], (192 // PERIOD_PX, 1))
    return wrapped(image), wrapped(np.roll(image, DISPARITY_PX, axis=0))


@pytest.mark.parametrize(
    ("repeats", "disparity_px", "known", "wrong"),
    [
        (True, DISPARITY_PX - PERIOD_PX, KNOWN, True),
        (True, DISPARITY_PX, KNOWN, False),  # that of its surroundings
        (False, DISPARITY_PX, np.add(KNOWN, (0, 0, PERIOD_PX)), False),  # another surface: it matches there only
        (True, DISPARITY_PX - PERIOD_PX, KNOWN[1:], False),  # too few know better
        (False, DISPARITY_PX, np.add(KNOWN, (0, 0, 100)), True),  # where its surroundings put it nothing is shown
    ],
)
def test_a_match_at_another_period_than_the_surroundings_is_wrong(
    repeats: bool, disparity_px: int, known: Array, wrong: bool
) -> None:
    found = has_wrong_period(pair(repeats), PIXEL, PIXEL[:, 1] + disparity_px, known)
    assert found.tolist() == [wrong]


@pytest.mark.parametrize(("repeats", "others"), [(True, [16.0, 64.0, 88.0]), (False, [])])
def test_disparities_at_which_a_pixel_matches_as_well(repeats: bool, others: list[float]) -> None:
    views = np.array([[100.0, 50.0, 50.0 + DISPARITY_PX], [200.5, 80.0, 80.0 + DISPARITY_PX]])
    found = disparities_alike(pair(repeats), views, 100)
    assert np.allclose(found[:, 0], DISPARITY_PX)
    for row in found:
        alike = np.sort(row[1:][np.isfinite(row[1:])])
        assert alike == pytest.approx(others, abs=0.1)
