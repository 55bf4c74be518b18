"""Plan view: positions, heights, size limits, readable without colour."""

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


def test_cells_are_darker_with_confidence_and_density() -> None:
    sure, unsure, tall = box(-1, 0), box(0, 0), np.vstack([box(1, 0, z) for z in np.arange(-0.5, 0.5, 0.1)])
    cloud = MapPoints(
        xyz=np.vstack([sure, unsure, tall]).astype(np.float32),
        confidence=np.repeat([0.9, 0.2, 0.9], [len(sure), len(unsure), len(tall)]).astype(np.float32),
        frames=np.ones(len(sure) + len(unsure) + len(tall), dtype=np.int32),
        age=np.zeros(len(sure) + len(unsure) + len(tall), dtype=np.int32),
    )
    grey = area(plan_view(cloud, NO_PATH))
    columns = np.array_split(np.where(grey < 255, grey, np.nan), 3, axis=1)
    tones = [float(np.nanmedian(part)) for part in columns]
    assert tones[2] < tones[0] < tones[1] < 200


def test_path_start_and_end_without_colour() -> None:
    path = np.stack([np.linspace(0, 8, 50), np.zeros(50)], axis=1)
    grey = area(plan_view(EMPTY, path))
    middle = grey[:, grey.shape[1] // 2]
    assert (middle < 100).sum() in range(2, 6)  # one thin dark line, in grey too
    left, right = np.array_split(grey, 2, axis=1)
    start, end = ((part < 60).sum() for part in (left, right))
    assert start > 60 and end > 120
    along = grey[grey.shape[0] // 2]
    assert along[np.flatnonzero(along < 60)[0] + 9] > 240  # the start is a ring, the end is filled
    assert not np.array_equal(plan_view(EMPTY, path), plan_view(EMPTY, path[::-1]))  # which end is which


@pytest.mark.parametrize("gap", [np.nan, np.inf])
def test_what_is_before_a_gap_of_the_path_is_not_joined_to_what_is_after(gap: float) -> None:
    parts = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[4.0, 0.0], [5.0, 0.0]])
    joined = plan_view(EMPTY, np.vstack(parts))
    apart = plan_view(EMPTY, np.vstack([parts[0], [[gap, gap]], parts[1], [[gap, gap]]]))
    changed = np.flatnonzero((joined != apart).any(axis=(0, 2))) / joined.shape[1]
    assert 0.2 < changed.min() < 0.35 and 0.65 < changed.max() < 0.8


def test_the_path_is_visible_on_a_dark_map() -> None:
    wall = np.vstack([box(x, 0.0, z) for x in np.arange(0, 5, 0.2) for z in np.arange(0, 1, 0.2)])
    image = plan_view(points(wall), np.array([[0.0, 0.0], [2.5, 0.0], [5.0, 0.0]]))
    grey = area(image)
    column = grey[:, grey.shape[1] // 4]
    line = np.flatnonzero(column > 240)
    rim = line[np.abs(line - grey.shape[0] // 2) < 8]
    assert rim.size >= 2 and rim.min() < grey.shape[0] // 2 < rim.max()


@pytest.mark.parametrize("path", [NO_PATH, np.zeros((1, 2)), np.full((3, 2), np.nan), OVERFLOWING])
def test_draws_an_image_of_an_almost_empty_map(path: NDArray[np.float64]) -> None:
    image = plan_view(EMPTY, path)
    assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3
    assert (image[MARGIN_PX - 20 :] < 100).any()  # axes


def test_same_input_gives_the_same_image() -> None:
    cloud, path = points(box(1, 2)), np.array([[0.0, 0.0], [1.0, 1.0]])
    assert np.array_equal(plan_view(cloud, path), plan_view(cloud, path))


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
