"""Plan view: the map from above, x (forward) to the right, y (left) up; readable in black and white."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.rig import LEAST_HEIGHT_M
from omnid.core.mapping.voxel_map import MapPoints
from omnid.formats.plan_sheet import (
    BLACK,
    BLUE,
    MARGIN_PX,
    RED,
    WHITE,
    Image,
    Sheet,
    cells_image,
    draw_frame,
    draw_start,
    write,
)
from omnid.formats.tum import POSITION_LIMIT_M

SIDE_LIMIT_PX = 2000
_MIN_SIDE_PX = 4 * MARGIN_PX
_SCALE_LIMIT_PX_PER_M = 100.0  # a small map is not enlarged beyond
_MIN_EXTENT_M = 2.0  # Least side of the drawn area, also of an empty map.
_DRAWN_QUANTILES = (0.005, 0.995)  # The area holds these quantiles: a few false far points must not shrink the rest.
_BORDER = 1.06  # drawn area over the extent of points and path
_MIN_ASPECT = 0.1  # shorter side over longer side, so that a straight path is visible
_END_HALF_PX = 6  # half the side of the square at the end of the path
_PATH_WIDTHS_PX = (7, 3)  # Widths of the white rim and of the line.
_LOW_M, _HIGH_M = -1.0, 1.5  # heights that are drawn, relative to the lower viewpoint
# Lower surfaces are the floor: obstacles begin at 0.06 m (obstacles.ring.heights_m), and a voxel of the map has 0.05 m.
_FLOOR_M = 0.1
NO_LOOPS: NDArray[np.float64] = np.zeros((0, 2, 2))


def drawn_heights(height_m: float) -> tuple[float, float]:
    """Return the lowest and the highest z [m] relative to the lower viewpoint that a plan shows: those above the floor.

    height_m: of the viewpoint above the floor; less than LEAST_HEIGHT_M, as 0, where the rig does not state it.
    """
    return (max(_LOW_M, _FLOOR_M - height_m) if height_m >= LEAST_HEIGHT_M else _LOW_M), _HIGH_M


def plan_view(
    points: MapPoints,
    trajectory_xy: NDArray[np.float64],
    *,
    heights_m: tuple[float, float] = (_LOW_M, _HIGH_M),
    max_side_px: int = 1400,
    loops_xy: NDArray[np.float64] = NO_LOOPS,
) -> Image:
    """Return a BGR image (H, W, 3) of the map's points between two heights [m], and the path (N, 2) [m] over it.

    A row of the path that is NaN, or too far away to be drawn, is a gap: what is before and after it is not joined.
    Heights are z of the points' frame. A cell is the darker, the more confident points it has. Neither side exceeds
    `max_side_px` (at most 2000). The farthest half per cent of the points on each side may be cut off, the path never.
    loops_xy: (L, 2, 2) [m] ends of lines between places of the path that were recognised as one.
    """
    drawable = _drawable(trajectory_xy)
    path = trajectory_xy[drawable].astype(np.float64)
    low_m, high_m = heights_m
    inside = _drawable(points.xyz) & (points.xyz[:, 2] >= low_m) & (points.xyz[:, 2] <= high_m)
    xy_m = points.xyz[inside, :2].astype(np.float64)
    sheet = _sheet(xy_m, path, int(np.clip(max_side_px, _MIN_SIDE_PX, SIDE_LIMIT_PX)))
    area = cells_image(sheet, xy_m, points.confidence[inside])
    margin = ((MARGIN_PX, MARGIN_PX), (MARGIN_PX, MARGIN_PX), (0, 0))
    image = np.pad(area, margin, constant_values=255)
    draw_frame(image, sheet)
    for loop in loops_xy:
        (x1, y1), (x2, y2) = sheet.pixels(loop).tolist()
        cv2.line(image, (x1, y1), (x2, y2), BLUE, 1, cv2.LINE_AA)
    gaps = np.flatnonzero(np.diff(np.flatnonzero(drawable)) > 1) + 1
    _draw_path(image, np.split(sheet.pixels(path), gaps))
    return image


def _drawable(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return flags of the rows that are finite and near enough to be drawn."""
    return np.asarray((np.abs(points) <= POSITION_LIMIT_M).all(axis=1))


def _sheet(xy_m: NDArray[np.float64], path: NDArray[np.float64], side_px: int) -> Sheet:
    """Return the area of the path and of the points within _DRAWN_QUANTILES."""
    bulk = np.quantile(xy_m, _DRAWN_QUANTILES, axis=0) if len(xy_m) else np.empty((0, 2))
    corners = np.vstack([bulk, path]) if len(bulk) or len(path) else np.zeros((1, 2))
    low_m, high_m = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum(_BORDER / 2 * (high_m - low_m), _MIN_EXTENT_M / 2)
    half = np.maximum(half, _MIN_ASPECT * half.max())
    usable_px = side_px - 2 * MARGIN_PX - 2
    centre = (low_m + high_m) / 2
    return Sheet(centre - half, centre + half, min(usable_px / (2 * float(half.max())), _SCALE_LIMIT_PX_PER_M))


def _draw_path(image: Image, parts_px: list[NDArray[np.int32]]) -> None:
    """Draw the parts of the path with a white rim, a circle at its start and a square at its end."""
    if not len(parts_px[0]):
        return
    for colour, width_px in zip((WHITE, RED), _PATH_WIDTHS_PX, strict=True):
        cv2.polylines(image, [part.reshape(-1, 1, 2) for part in parts_px], False, colour, width_px, cv2.LINE_AA)
    end, start = ((int(x), int(y)) for x, y in (parts_px[-1][-1], parts_px[0][0]))
    for colour, half_px in ((WHITE, _END_HALF_PX + 1), (BLACK, _END_HALF_PX)):
        corners = (end[0] - half_px, end[1] - half_px), (end[0] + half_px, end[1] + half_px)
        cv2.rectangle(image, *corners, colour, cv2.FILLED)
    draw_start(image, start)
    write(image, "end", (end[0], end[1] + 24))
