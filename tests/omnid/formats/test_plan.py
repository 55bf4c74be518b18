"""Plan view: positions, heights, size limits."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.mapping.voxel_map import MapPoints
from omnid.formats.plan import drawn_heights, plan_view

MARGIN_PX = 64
NO_PATH = np.empty((0, 2))
OVERFLOWING = np.array([[1e308, 0.0], [-1e308, 0.0]])


def points(xyz: NDArray[np.float64], confidence: float = 0.8) -> MapPoints:
    ones = np.ones(len(xyz), dtype=np.int32)
    return MapPoints(xyz.astype(np.float32), np.full(len(xyz), confidence, dtype=np.float32), ones, ones)


EMPTY = points(np.empty((0, 3)))


def box(x_m: float, y_m: float, z_m: float = 0.0) -> NDArray[np.float64]:
    """Return a filled square of 0.4 m about a point."""
    grid = np.arange(-0.2, 0.21, 0.05)
    x, y = np.meshgrid(x_m + grid, y_m + grid)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z_m)], axis=1)


def area(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the drawn area without its border, as grey levels."""
    inside = image[MARGIN_PX + 2 : -MARGIN_PX - 2, MARGIN_PX + 2 : -MARGIN_PX - 2]
    return np.asarray(cv2.cvtColor(inside, cv2.COLOR_BGR2GRAY), dtype=np.float64)


def dark_centre(image: NDArray[np.uint8]) -> tuple[float, float]:
    """Return mean column and row of the dark pixels, as fractions of the drawn area."""
    grey = area(image)
    rows, columns = np.nonzero(grey < 200)
    return float(columns.mean() / grey.shape[1]), float(rows.mean() / grey.shape[0])


def test_forward_is_right_and_left_is_up() -> None:
    frame = np.array([[-3.0, -3.0], [3.0, 3.0]])
    for x_m, y_m in ((2.0, 1.0), (-2.0, -1.0), (0.5, -2.0)):
        cloud = np.vstack([box(x_m, y_m), [[*corner, 0.0] for corner in frame]])
        column, row = dark_centre(plan_view(points(cloud), NO_PATH))
        assert column == pytest.approx(0.5 + x_m / 6.36, abs=0.02)
        assert row == pytest.approx(0.5 - y_m / 6.36, abs=0.02)


def test_only_the_height_band_is_drawn() -> None:
    cloud = points(np.vstack([box(0, 0, -2.0), box(0, 0, 2.0)]))
    assert (area(plan_view(cloud, NO_PATH)) == 255).all()
    assert (area(plan_view(cloud, NO_PATH, heights_m=(-1.0, 2.5))) < 200).any()
    assert (area(plan_view(cloud, NO_PATH, heights_m=(-2.5, 1.5))) < 200).any()


@pytest.mark.parametrize(("height_m", "is_drawn"), [(0.0, True), (0.9, False), (0.4, False), (1.2, False)])
def test_the_floor_below_cameras_of_known_height_is_not_drawn(height_m: float, is_drawn: bool) -> None:
    """It filled the plans of robots whose cameras are lower than a metre; a box on it is drawn."""
    floor_m = -(height_m or 0.9)
    heights_m = drawn_heights(height_m)
    assert (area(plan_view(points(box(0, 0, floor_m + 0.02)), NO_PATH, heights_m=heights_m)) < 200).any() == is_drawn
    assert (area(plan_view(points(box(0, 0, floor_m + 0.25)), NO_PATH, heights_m=heights_m)) < 200).any()


@pytest.mark.parametrize("path", [NO_PATH, np.zeros((1, 2)), np.full((3, 2), np.nan), OVERFLOWING])
def test_draws_an_image_of_an_almost_empty_map(path: NDArray[np.float64]) -> None:
    image = plan_view(EMPTY, path)
    assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3
    assert (image[MARGIN_PX - 20 :] < 100).any()  # axes


@pytest.mark.parametrize("extent_m", [0.01, 3.0, 250.0, 1e6, 1e9])
@pytest.mark.parametrize("side_px", [1, 300, 1400, 10**6])
def test_size_is_bounded_for_any_extent(extent_m: float, side_px: int) -> None:
    for shape in ([1.0, 0.0], [0.0, 1.0], [1.0, -0.7]):
        path = np.linspace(0, extent_m, 30)[:, None] * shape
        image = plan_view(points(box(0, 0)), path, max_side_px=side_px)
        assert max(image.shape) <= max(256, min(side_px, 2000)) and min(image.shape[:2]) > 2 * MARGIN_PX + 10
