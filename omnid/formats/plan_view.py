"""Plan view: the map from above, x (forward) to the right, y (left) up; readable in black and white."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.voxel_map import MapPoints
from omnid.formats.tum import POSITION_LIMIT_M

Image = NDArray[np.uint8]

SIDE_LIMIT_PX = 2000
_MARGIN_PX = 64
_MIN_SIDE_PX = 4 * _MARGIN_PX
_SCALE_LIMIT_PX_PER_M = 100.0  # a small map is not enlarged beyond
_CELL_M = 0.05  # default voxel: at a finer scale cells are drawn as squares, not as scattered dots
_MIN_EXTENT_M = 2.0  # of the drawn area, also of an empty map
_DRAWN_QUANTILES = (0.005, 0.995)  # of the points: a few false far ones must not shrink the rest
_BORDER = 1.06  # drawn area over the extent of points and path
_MIN_ASPECT = 0.1  # shorter side over longer side, so that a straight path is visible
_WEAKEST_GREY = 190.0  # of a cell with the least confidence
_TICK_SPACING_PX = 110.0  # at most
_TICK_PX = 6
_FONT_SCALE = 0.5
_CHARACTER_PX = 5  # half the width of a character
_END_HALF_PX = 6  # half the side of the square at the end of the path
_START_RADIUS_PX = 9  # of the circle at its start
_START_INNER_PX = 6
_PATH_WIDTHS_PX = (7, 3)  # of the white rim and of the line
_WHITE, _BLACK, _RED = (255, 255, 255), (0, 0, 0), (0, 0, 190)  # BGR
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, slots=True)
class _Sheet:
    """Drawn area in metres and its scale."""

    low_m: NDArray[np.float64]  # (2,) x, y of the drawn area's lower left corner
    high_m: NDArray[np.float64]  # (2,)
    px_per_m: float

    @property
    def area_px(self) -> tuple[int, int]:
        """Width and height of the drawn area."""
        size = np.floor((self.high_m - self.low_m) * self.px_per_m).astype(int) + 1
        return int(size[0]), int(size[1])

    def pixels(self, xy_m: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return image coordinates (N, 2) of points (N, 2); y grows downwards there."""
        corner = np.array([_MARGIN_PX, _MARGIN_PX + self.area_px[1] - 1])
        return np.asarray(np.rint(corner + (xy_m - self.low_m) * self.px_per_m * [1, -1]), dtype=np.int32)


def plan_view(
    points: MapPoints,
    trajectory_xy: NDArray[np.float64],
    *,
    z_low_m: float = -1.0,
    z_high_m: float = 1.5,
    max_side_px: int = 1400,
) -> Image:
    """Return a BGR image (H, W, 3) of the map's points between two heights, and the path (N, 2) in metres over it.

    Heights are relative to the first pose, the origin of the map's frame. A cell is the darker, the more confident
    points it has. Neither side exceeds `max_side_px` (at most 2000). The farthest half per cent of the points on each
    side may be cut off; the path never is.
    """
    path = trajectory_xy[_drawable(trajectory_xy)].astype(np.float64)
    inside = _drawable(points.xyz) & (points.xyz[:, 2] >= z_low_m) & (points.xyz[:, 2] <= z_high_m)
    xy_m = points.xyz[inside, :2].astype(np.float64)
    sheet = _sheet(xy_m, path, int(np.clip(max_side_px, _MIN_SIDE_PX, SIDE_LIMIT_PX)))
    area = _cells_image(sheet, xy_m, points.confidence[inside])
    margin = ((_MARGIN_PX, _MARGIN_PX), (_MARGIN_PX, _MARGIN_PX), (0, 0))
    image = np.pad(area, margin, constant_values=255)
    _draw_frame(image, sheet)
    _draw_path(image, sheet.pixels(path))
    return image


def _drawable(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return flags of the rows that are finite and near enough to be drawn."""
    return np.asarray((np.abs(points) <= POSITION_LIMIT_M).all(axis=1))


def _sheet(xy_m: NDArray[np.float64], path: NDArray[np.float64], side_px: int) -> _Sheet:
    """Return the area of the path and of the points within _DRAWN_QUANTILES."""
    bulk = np.quantile(xy_m, _DRAWN_QUANTILES, axis=0) if len(xy_m) else np.empty((0, 2))
    corners = np.vstack([bulk, path]) if len(bulk) or len(path) else np.zeros((1, 2))
    low_m, high_m = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum(_BORDER / 2 * (high_m - low_m), _MIN_EXTENT_M / 2)
    half = np.maximum(half, _MIN_ASPECT * half.max())
    usable_px = side_px - 2 * _MARGIN_PX - 2
    centre = (low_m + high_m) / 2
    return _Sheet(centre - half, centre + half, min(usable_px / (2 * float(half.max())), _SCALE_LIMIT_PX_PER_M))


def _cells_image(sheet: _Sheet, xy_m: NDArray[np.float64], confidence: NDArray[np.float32]) -> Image:
    """Return the image of the drawn area, white where the map has no points."""
    width, height = sheet.area_px
    cell_px = int(np.ceil(sheet.px_per_m * _CELL_M))  # never finer than a voxel: no white lines in a wall
    columns, rows = -(-width // cell_px), -(-height // cell_px)
    cell = np.floor((xy_m - sheet.low_m) * sheet.px_per_m / cell_px)
    drawn = ((cell >= 0) & (cell < [columns, rows])).all(axis=1)
    column, row = cell[drawn].astype(np.int64).T
    density = np.asarray(np.bincount(row * columns + column, confidence[drawn], columns * rows), dtype=np.float64)
    grey = _tone(density).reshape(rows, columns).repeat(cell_px, axis=0).repeat(cell_px, axis=1)
    return np.repeat(grey[:height, :width][::-1, :, None], 3, axis=2)


def _tone(density: NDArray[np.float64]) -> Image:
    """Return grey levels: 255 for empty cells, else from _WEAKEST_GREY down to 0 with the density."""
    filled = density[density > 0]
    median = float(np.median(filled)) if filled.size else 1.0
    return np.where(density > 0, _WEAKEST_GREY - _WEAKEST_GREY * density / (density + median), 255.0).astype(np.uint8)


def _draw_frame(image: Image, sheet: _Sheet) -> None:
    """Draw the border, ticks in metres on two sides, the names of the axes and a scale bar."""
    step_m = _round_length_m(_TICK_SPACING_PX / sheet.px_per_m)
    (left, bottom), (right, top) = sheet.pixels(np.array([sheet.low_m, sheet.high_m]))
    for axis in (0, 1):
        first, last = np.ceil(sheet.low_m[axis] / step_m), np.floor(sheet.high_m[axis] / step_m)
        for value_m in step_m * np.arange(first, last + 1):
            _draw_tick(image, sheet, axis, float(value_m))
    cv2.rectangle(image, (int(left), int(top)), (int(right), int(bottom)), _BLACK, 1)
    _write(image, "x forward [m]", (int(left + right) // 2, int(bottom) + 44))
    _write(image, "y left [m]", (int(left), int(top) - 10))
    _draw_scale_bar(image, step_m, sheet.px_per_m, int(right))


def _draw_tick(image: Image, sheet: _Sheet, axis: int, value_m: float) -> None:
    at = sheet.low_m.copy()
    at[axis] = value_m
    x, y = (int(v) for v in sheet.pixels(at[None])[0])
    label = f"{value_m + 0.0:g}"  # no -0
    if axis == 0:
        cv2.line(image, (x, y), (x, y + _TICK_PX), _BLACK, 1)
        _write(image, label, (x, y + 22))
    else:
        cv2.line(image, (x - _TICK_PX, y), (x, y), _BLACK, 1)
        _write(image, label, (x - 2 * _TICK_PX - _CHARACTER_PX * len(label), y + 5))


def _draw_scale_bar(image: Image, length_m: float, px_per_m: float, right: int) -> None:
    """Draw a bar of a round length in the margin at the upper right."""
    left, y = right - round(length_m * px_per_m), _MARGIN_PX - 14
    cv2.rectangle(image, (left, y - 3), (right, y + 3), _BLACK, cv2.FILLED)
    _write(image, f"{length_m:g} m", ((left + right) // 2, y - 10))


def _draw_path(image: Image, path_px: NDArray[np.int32]) -> None:
    """Draw the path with a white rim, a circle at its start and a square at its end."""
    if not len(path_px):
        return
    for colour, width_px in zip((_WHITE, _RED), _PATH_WIDTHS_PX, strict=True):
        cv2.polylines(image, [path_px.reshape(-1, 1, 2)], False, colour, width_px, cv2.LINE_AA)
    end, start = ((int(x), int(y)) for x, y in (path_px[-1], path_px[0]))
    for colour, half_px in ((_WHITE, _END_HALF_PX + 1), (_BLACK, _END_HALF_PX)):
        corners = (end[0] - half_px, end[1] - half_px), (end[0] + half_px, end[1] + half_px)
        cv2.rectangle(image, *corners, colour, cv2.FILLED)
    cv2.circle(image, start, _START_RADIUS_PX, _BLACK, cv2.FILLED, cv2.LINE_AA)
    cv2.circle(image, start, _START_INNER_PX, _WHITE, cv2.FILLED, cv2.LINE_AA)
    _write(image, "end", (end[0], end[1] + 24))
    _write(image, "start", (start[0], start[1] - 14))


def _write(image: Image, text: str, centre_bottom: tuple[int, int]) -> None:
    """Write black text on white, centred above a point."""
    (width, height), below = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
    left, bottom = centre_bottom[0] - width // 2, centre_bottom[1]
    cv2.rectangle(image, (left - 2, bottom - height - 1), (left + width + 2, bottom + below), _WHITE, cv2.FILLED)
    cv2.putText(image, text, (left, bottom), _FONT, _FONT_SCALE, _BLACK, 1, cv2.LINE_AA)


def _round_length_m(length_m: float) -> float:
    """Return the greatest of ..., 0.5, 1, 2, 5, 10, ... that is not longer."""
    decade = 10.0 ** np.floor(np.log10(length_m))
    return float(decade * max(digit for digit in (1, 2, 5) if digit * decade <= length_m))
