"""Sheet of a plan: the frame with ticks in metres, a scale bar, a start mark, a legend, and cells of points.

x (forward) is to the right, y (left) up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]  # BGR

MARGIN_PX = 64
WHITE, BLACK, RED, LIGHT_GREY = (255, 255, 255), (0, 0, 0), (0, 0, 190), (205, 205, 205)
BLUE = (200, 100, 0)
_CELL_M = 0.05  # default voxel: at a finer scale cells are drawn as squares, not as scattered dots
_WEAKEST_GREY = 190.0  # Grey level of a cell with the least confidence.
_TICK_SPACING_PX = 110.0  # Largest spacing of ticks.
_TICK_PX = 6
_FONT_SCALE = 0.5
_CHARACTER_PX = 5  # half the width of a character
_START_RADIUS_PX = 9  # Radius of the circle at the start of a path.
_START_INNER_PX = 6
_LEGEND_LINE_PX = 30  # length of the sample of a line
_LEGEND_GAP_PX = 28
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, slots=True)
class Sheet:
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
        corner = np.array([MARGIN_PX, MARGIN_PX + self.area_px[1] - 1])
        return np.asarray(np.rint(corner + (xy_m - self.low_m) * self.px_per_m * [1, -1]), dtype=np.int32)


def cells_image(sheet: Sheet, xy_m: NDArray[np.float64], confidence: NDArray[np.float32]) -> Image:
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


def draw_frame(image: Image, sheet: Sheet) -> None:
    """Draw the border, ticks in metres on two sides, the names of the axes and a scale bar."""
    step_m = _round_length_m(_TICK_SPACING_PX / sheet.px_per_m)
    (left, bottom), (right, top) = sheet.pixels(np.array([sheet.low_m, sheet.high_m]))
    for axis in (0, 1):
        first, last = np.ceil(sheet.low_m[axis] / step_m), np.floor(sheet.high_m[axis] / step_m)
        for value_m in step_m * np.arange(first, last + 1):
            _draw_tick(image, sheet, axis, float(value_m))
    cv2.rectangle(image, (int(left), int(top)), (int(right), int(bottom)), BLACK, 1)
    write(image, "x forward [m]", (int(left + right) // 2, int(bottom) + 44))
    write(image, "y left [m]", (int(left), int(top) - 10))
    _draw_scale_bar(image, step_m, sheet.px_per_m, int(right))


def _draw_tick(image: Image, sheet: Sheet, axis: int, value_m: float) -> None:
    at = sheet.low_m.copy()
    at[axis] = value_m
    x, y = (int(v) for v in sheet.pixels(at[None])[0])
    label = f"{value_m + 0.0:g}"  # no -0
    if axis == 0:
        cv2.line(image, (x, y), (x, y + _TICK_PX), BLACK, 1)
        write(image, label, (x, y + 22))
    else:
        cv2.line(image, (x - _TICK_PX, y), (x, y), BLACK, 1)
        write(image, label, (x - 2 * _TICK_PX - _CHARACTER_PX * len(label), y + 5))


def _draw_scale_bar(image: Image, length_m: float, px_per_m: float, right: int) -> None:
    """Draw a bar of a round length in the margin at the upper right."""
    left, y = right - round(length_m * px_per_m), MARGIN_PX - 14
    cv2.rectangle(image, (left, y - 3), (right, y + 3), BLACK, cv2.FILLED)
    write(image, f"{length_m:g} m", ((left + right) // 2, y - 10))


def draw_start(image: Image, start: tuple[int, int]) -> None:
    """Draw a circle with its name at the start of a path."""
    cv2.circle(image, start, _START_RADIUS_PX, BLACK, cv2.FILLED, cv2.LINE_AA)
    cv2.circle(image, start, _START_INNER_PX, WHITE, cv2.FILLED, cv2.LINE_AA)
    write(image, "start", (start[0], start[1] - 14))


def with_legend(image: Image, lines: Sequence[tuple[str, Colour, int]]) -> Image:
    """Return the image with a row below: for each line its name, after a sample of its colour and width [px]."""
    image = np.pad(image, ((0, _LEGEND_GAP_PX), (0, 0), (0, 0)), constant_values=255)
    left, y = MARGIN_PX, image.shape[0] - _LEGEND_GAP_PX
    for name, colour, width_px in lines:
        (width, height), _ = cv2.getTextSize(name, _FONT, _FONT_SCALE, 1)
        cv2.line(image, (left, y), (left + _LEGEND_LINE_PX, y), colour, width_px, cv2.LINE_AA)
        left += _LEGEND_LINE_PX + 8
        cv2.putText(image, name, (left, y + height // 2), _FONT, _FONT_SCALE, BLACK, 1, cv2.LINE_AA)
        left += width + _LEGEND_GAP_PX
    return image


def write(image: Image, text: str, centre_bottom: tuple[int, int]) -> None:
    """Write black text on white, centred above a point."""
    (width, height), below = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
    left, bottom = centre_bottom[0] - width // 2, centre_bottom[1]
    cv2.rectangle(image, (left - 2, bottom - height - 1), (left + width + 2, bottom + below), WHITE, cv2.FILLED)
    cv2.putText(image, text, (left, bottom), _FONT, _FONT_SCALE, BLACK, 1, cv2.LINE_AA)


def _round_length_m(length_m: float) -> float:
    """Return the greatest of ..., 0.5, 1, 2, 5, 10, ... that is not longer."""
    decade = 10.0 ** np.floor(np.log10(length_m))
    return float(decade * max(digit for digit in (1, 2, 5) if digit * decade <= length_m))
