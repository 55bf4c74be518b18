"""Plan: a map from above with paths over it, x (forward) to the right, y (left) up; readable in black and white."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.rig import LEAST_HEIGHT_M
from omnid.core.mapping.voxel_map import MapPoints
from omnid.formats.tum import POSITION_LIMIT_M

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Colour = tuple[int, int, int]  # BGR

MARGIN_PX = 64
MARK_PX = 11  # size of marks and distance of labels
SIDE_PX = 1400  # of an image, at most
WHITE, BLACK, RED, BLUE, LIGHT_GREY = (255, 255, 255), (0, 0, 0), (0, 0, 190), (200, 100, 0), (205, 205, 205)
_CELL_M = 0.05  # default voxel: at a finer scale cells are drawn as squares, not as scattered dots


@dataclass(frozen=True, slots=True)
class Sheet:
    """Drawn area in metres and its scale."""

    low_m: Array  # (2,) x, y of the drawn area's lower left corner
    high_m: Array  # (2,)
    px_per_m: float

    @property
    def area_px(self) -> tuple[int, int]:
        """Width and height of the drawn area."""
        size = np.floor((self.high_m - self.low_m) * self.px_per_m).astype(int) + 1
        return int(size[0]), int(size[1])

    def pixels(self, xy_m: Array) -> NDArray[np.int32]:
        """Return image coordinates (N, 2) of points (N, 2); y grows downwards there."""
        corner = np.array([MARGIN_PX, MARGIN_PX + self.area_px[1] - 1])
        return np.asarray(np.rint(corner + (xy_m - self.low_m) * self.px_per_m * [1, -1]), dtype=np.int32)


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines of one style."""

    parts: Sequence[Array]  # each (N, 2) m
    colour: Colour
    width_px: int
    rim_px: int = 0  # width of a white rim; 0: none


def drawn_heights(height_m: float) -> tuple[float, float]:
    """Return the lowest and the highest z [m] relative to the lower viewpoint that a plan shows: those above the floor.

    height_m: of the viewpoint above the floor; less than LEAST_HEIGHT_M, as 0, where the rig does not state it.
    Lower surfaces are the floor: obstacles begin at 0.06 m (obstacles.scan.heights_m), and a voxel has 0.05 m.
    """
    return max(-1.0, 0.1 - height_m if height_m >= LEAST_HEIGHT_M else -1.0), 1.5


def plan_view(
    points: MapPoints,
    trajectory_xy: Array,
    *,
    heights_m: tuple[float, float],
    loops_xy: Iterable[Array] = (),
) -> Image:
    """Return a BGR image (H, W, 3) of the map's points between two heights [m], and the path (N, 2) [m] over it.

    A row of the path that is NaN, or too far away to be drawn, is a gap: what is before and after it is not joined.
    Heights are z of the points' frame. A cell is the darker, the more confident points it has. Neither side exceeds
    SIDE_PX. The farthest half per cent of the points on each side may be cut off, the path never.
    loops_xy: (L, 2, 2) [m] ends of lines between places of the path that were recognised as one.
    """
    drawable = _drawable(trajectory_xy)
    path = trajectory_xy[drawable].astype(np.float64)
    xy_m, confidence = between(points.xyz, points.confidence, heights_m)
    sheet = sheet_of(xy_m, path)
    gaps = np.flatnonzero(np.diff(np.flatnonzero(drawable)) > 1) + 1
    lines = [Lines(np.split(path, gaps), RED, 3, rim_px=7), Lines(list(loops_xy), BLUE, 1)]
    image = draw_plan(sheet, xy_m, confidence, lines)
    if len(path):
        draw_ends(image, sheet, path[0], path[-1])
    return image


def between(
    xyz: NDArray[np.floating], confidence: NDArray[np.float32], heights_m: tuple[float, float]
) -> tuple[Array, NDArray[np.float32]]:
    """Return x, y (N, 2) and confidence of the points (M, 3) that can be drawn, between two heights [m]."""
    inside = _drawable(xyz) & (xyz[:, 2] >= heights_m[0]) & (xyz[:, 2] <= heights_m[1])
    return xyz[inside, :2].astype(np.float64), confidence[inside]


def _drawable(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return flags of the rows that are finite and near enough to be drawn."""
    return np.asarray((np.abs(points) <= POSITION_LIMIT_M).all(axis=1))


def sheet_of(xy_m: Array, path: Array) -> Sheet:
    """Return the area of the path and of 99 % of the points: a few false far points must not shrink the rest."""
    bulk = np.quantile(xy_m, (0.005, 0.995), axis=0) if len(xy_m) else np.empty((0, 2))
    corners = np.vstack([bulk, path]) if len(bulk) or len(path) else np.zeros((1, 2))
    low_m, high_m = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum(1.06 / 2 * (high_m - low_m), 1.0)  # an empty map has 2 m as well
    half = np.maximum(half, 0.1 * half.max())  # a straight path is visible
    usable_px = SIDE_PX - 2 * MARGIN_PX - 2
    centre = (low_m + high_m) / 2
    return Sheet(centre - half, centre + half, min(usable_px / (2 * float(half.max())), 100.0))


def draw_plan(sheet: Sheet, xy_m: Array, confidence: NDArray[np.float32], lines: Sequence[Lines]) -> Image:
    """Return the image of a sheet: points (N, 2) as grey cells, the frame with ticks, and lines over them."""
    margin = ((MARGIN_PX, MARGIN_PX), (MARGIN_PX, MARGIN_PX), (0, 0))
    image = np.pad(_cells(sheet, xy_m, confidence), margin, constant_values=255)
    _draw_frame(image, sheet)
    for line in lines:
        parts = [sheet.pixels(part).reshape(-1, 1, 2) for part in line.parts if len(part)]
        for colour, width_px in ((WHITE, line.rim_px), (line.colour, line.width_px)):
            if parts and width_px:
                cv2.polylines(image, parts, False, colour, width_px, cv2.LINE_AA)
    return image


def draw_ends(image: Image, sheet: Sheet, start: Array, end: Array | None = None) -> None:
    """Draw a circle with its name at the start of a path, and one that is filled at its end."""
    for point, name, inside in ((end, "end", BLACK), (start, "start", WHITE)):
        if point is not None:
            ((x, y),) = sheet.pixels(point[None]).tolist()
            cv2.circle(image, (x, y), MARK_PX - 2, BLACK, cv2.FILLED, cv2.LINE_AA)
            cv2.circle(image, (x, y), MARK_PX // 2, inside, cv2.FILLED, cv2.LINE_AA)
            write(image, name, (x, y - MARK_PX if name == "start" else y + 2 * MARK_PX))


def _cells(sheet: Sheet, xy_m: Array, confidence: NDArray[np.float32]) -> Image:
    """Return the drawn area: white where there are no points, else the darker, the more confident points a cell has."""
    width, height = sheet.area_px
    cell_px = int(np.ceil(sheet.px_per_m * _CELL_M))  # never finer than a voxel: no white lines in a wall
    columns, rows = -(-width // cell_px), -(-height // cell_px)
    cell = np.floor((xy_m - sheet.low_m) * sheet.px_per_m / cell_px)
    drawn = ((cell >= 0) & (cell < [columns, rows])).all(axis=1)
    column, row = cell[drawn].astype(np.int64).T
    density = np.bincount(row * columns + column, confidence[drawn], columns * rows)
    filled = density[density > 0]
    median = float(np.median(filled)) if filled.size else 1.0
    grey = np.where(density > 0, 190.0 - 190.0 * density / (density + median), 255.0).astype(np.uint8)
    grey = grey.reshape(rows, columns).repeat(cell_px, axis=0).repeat(cell_px, axis=1)
    return np.repeat(grey[:height, :width][::-1, :, None], 3, axis=2)


def _draw_frame(image: Image, sheet: Sheet) -> None:
    """Draw the border, the names of the axes and a scale bar."""
    # The longest bar of 1, 2 or 5 times a power of ten that is not much longer than its label.
    longest_m = 2 * MARGIN_PX / sheet.px_per_m
    decade = 10.0 ** np.floor(np.log10(longest_m))
    bar_m = float(decade * max(digit for digit in (1, 2, 5) if digit * decade <= longest_m))
    (left, bottom), (right, top) = sheet.pixels(np.stack([sheet.low_m, sheet.high_m])).tolist()
    cv2.rectangle(image, (left, top), (right, bottom), BLACK, 1)
    write(image, "x forward", ((left + right) // 2, bottom + 2 * MARK_PX))
    write(image, "y left", (left, top - MARK_PX))
    bar, y = right - round(bar_m * sheet.px_per_m), MARGIN_PX - MARK_PX
    cv2.rectangle(image, (bar, y - MARK_PX // 2), (right, y), BLACK, cv2.FILLED)
    write(image, f"{bar_m:g} m", ((bar + right) // 2, y - MARK_PX))


def with_legend(image: Image, lines: Sequence[tuple[str, Colour, int]]) -> Image:
    """Return the image with a row below: for each line its name, after a sample of its colour and width [px]."""
    gap_px, left = 28, MARGIN_PX
    image = np.pad(image, ((0, gap_px), (0, 0), (0, 0)), constant_values=255)
    y = image.shape[0] - gap_px
    for name, colour, width_px in lines:
        cv2.line(image, (left, y), (left + gap_px, y), colour, width_px, cv2.LINE_AA)
        left += 2 * gap_px + write(image, name, (left + gap_px + MARK_PX, y + MARK_PX // 2), is_centred=False)
    return image


def write(image: Image, text: str, bottom: tuple[int, int], *, is_centred: bool = True) -> int:
    """Write black text on white above a point, centred or to the right of it; return its width [px]."""
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.5
    (width, height), below = cv2.getTextSize(text, font, scale, 1)
    left, y = bottom[0] - (width // 2 if is_centred else 0), bottom[1]
    cv2.rectangle(image, (left - 2, y - height - 1), (left + width + 2, y + below), WHITE, cv2.FILLED)
    cv2.putText(image, text, (left, y), font, scale, BLACK, 1, cv2.LINE_AA)
    return width
