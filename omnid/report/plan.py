"""Plan view of path and map: x (forward) to the right, y (left) up, in metres."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.report.chart import Clock
from omnid.report.downsampling import Corner
from omnid.report.svg import Point, coord, key, label, mark_key, path_d, pixel_image, polyline, round_step, text

Array = NDArray[np.float64]

_MAX_SIDES_PX: Final = (1000.0, 760.0)
_MIN_SIDE_M: Final = 1.0
_MIN_ASPECT: Final = 0.15  # Least ratio of the shorter to the longer side.
_MARGIN_SHARE: Final = 0.03  # Margin on either side by the extent.
_MAX_COORDINATE_M: Final = 1e6  # points beyond are invalid
_MAX_PX_PER_M: Final = 400.0
_MARGIN: Final = (44.0, 26.0, 14.0, 44.0)  # left, top, right, bottom [px]
_CELL_M: Final = 0.05  # default voxel of the map
_TIME_MARKS: Final = 6  # along the path
_GREYS: Final = 12  # few, so that the image stays small


@dataclass(frozen=True, slots=True)
class Plan:
    """Content of the figure."""

    corners: Sequence[Corner]
    points: NDArray[np.float32]  # (N, 3) m, of the map
    confidence: NDArray[np.float32]  # (N,)
    height_m: float  # of the rig at the start
    heights_m: tuple[float, float]  # that are drawn, relative to that of the rig at the start
    truth: Sequence[Point] = ()  # x, y of the true path
    in_map: Sequence[Point] = ()  # x, y of the path in the map, where it is another one
    lost: Sequence[Point] = ()  # positions at which the pose was lost
    restarts_s: Sequence[float] = ()  # times at which a path with a new odom begins


@dataclass(frozen=True, slots=True)
class _PlanArea:
    low: Point  # m
    high: Point
    px_per_m: float

    def px(self, x_m: float, y_m: float) -> Point:
        return (_MARGIN[0] + (x_m - self.low[0]) * self.px_per_m, _MARGIN[1] + (self.high[1] - y_m) * self.px_per_m)

    @property
    def size(self) -> Point:
        return ((self.high[0] - self.low[0]) * self.px_per_m, (self.high[1] - self.low[1]) * self.px_per_m)


def plan_figure(plan: Plan, clock: Clock) -> str:
    """Return the figure."""
    low, high = plan.heights_m
    inside = (plan.points[:, 2] >= plan.height_m + low) & (plan.points[:, 2] <= plan.height_m + high)
    points_xy, confidence = plan.points[inside, :2].astype(float), plan.confidence[inside]
    sheet = _plan_area([*((c.x_m, c.y_m) for c in plan.corners), *plan.truth, *plan.in_map], points_xy)
    width, height = sheet.size
    parts = [
        *_map(sheet, points_xy, confidence),
        *_frame(sheet),
        *_line(sheet, plan.truth, "pt"),
        *_line(sheet, plan.in_map, "pm"),
        *_path(sheet, _runs(plan.corners, plan.restarts_s)),
        *_times(sheet, plan.corners, clock),
        *(_cross(*sheet.px(*position)) for position in plan.lost),
        *_ends(sheet, plan.corners),
    ]
    box = f"0 0 {coord(width + _MARGIN[0] + _MARGIN[2])} {coord(height + _MARGIN[1] + _MARGIN[3])}"
    return (
        f"<figure class='plan'><figcaption><b>Path and map</b> {_keys(plan)}</figcaption><svg viewBox='{box}' "
        f"role='img' aria-label='Path and map' data-m='{_metres(sheet)}'>{''.join(parts)}</svg>"
        f"<small>{_footnote(plan, len(points_xy))}</small></figure>"
    )


def _metres(sheet: _PlanArea) -> str:
    """Return x and y [m] of the figure's pixel (0, 0), and pixels per metre."""
    x_m, y_m = sheet.low[0] - _MARGIN[0] / sheet.px_per_m, sheet.high[1] + _MARGIN[1] / sheet.px_per_m
    return f"{x_m!r} {y_m!r} {sheet.px_per_m!r}"


def _keys(plan: Plan) -> str:
    ranks = {max(corner.rank, 0) for corner in plan.corners[1:]}
    names = ("the path, tracking", "degraded", "lost")
    known = any(corner.rank >= 0 for corner in plan.corners)
    shown = [key(f"class='p{rank}'", names[rank] if known else "the path") for rank in sorted(ranks)]
    shown += [mark_key(_cross(17, 6), "lost here")] if plan.lost else []
    shown += [key("class='pm'", "in the map")] if plan.in_map else []
    return "".join([*shown, *([key("class='pt'", "the true path")] if plan.truth else [])])


def _footnote(plan: Plan, drawn: int) -> str:
    if not len(plan.points):
        return "The log holds no map that can be drawn."
    low, high = plan.heights_m
    return (
        f"Grey: {drawn} of the map's {len(plan.points)} points, those from {-low:g} m below the rig's height at "
        f"the start to {high:g} m above it; they stand out by their confidence and number in a column."
    )


def _plan_area(path: Sequence[Point], points_xy: Array) -> _PlanArea:
    """Return the area of the path and 99 % of the points: a few far outliers must not shrink the rest."""
    corners = np.array(path)
    near = np.abs(points_xy).max(axis=1, initial=0.0) <= _MAX_COORDINATE_M
    if near.any():
        corners = np.vstack([corners, np.quantile(points_xy[near], [0.005, 0.995], axis=0)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum((0.5 + _MARGIN_SHARE) * (high - low), _MIN_SIDE_M / 2)
    half = np.maximum(half, _MIN_ASPECT * half.max())
    centre = (low + high) / 2
    px_per_m = min(_MAX_PX_PER_M, *(side / (2 * float(h)) for side, h in zip(_MAX_SIDES_PX, half, strict=True)))
    (x0, y0), (x1, y1) = centre - half, centre + half
    return _PlanArea((float(x0), float(y0)), (float(x1), float(y1)), px_per_m)


def _map(sheet: _PlanArea, points_xy: Array, confidence: NDArray[np.float32]) -> Iterator[str]:
    """Yield the points as a grey image with one pixel per cell of the map or pixel of the page."""
    if not len(points_xy):
        return
    cell_m = max(_CELL_M, 1.25 / sheet.px_per_m)
    counts = [math.ceil((high - low) / cell_m) for low, high in zip(sheet.low, sheet.high, strict=True)]
    sides = [(low, low + count * cell_m) for low, count in zip(sheet.low, counts, strict=True)]
    weights = np.clip(np.nan_to_num(confidence), 0.0, 1.0)
    ink = np.histogram2d(points_xy[:, 0], points_xy[:, 1], counts, sides, weights=weights)[0].T[::-1]
    png = cv2.imencode(".png", _tone(ink), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
    (left, top), (right, bottom) = sheet.px(sides[0][0], sides[1][1]), sheet.px(sides[0][1], sides[1][0])
    yield pixel_image(png.tobytes(), (left, top), (right - left, bottom - top))


def _tone(ink: Array) -> NDArray[np.uint8]:
    """Return greys: white for empty cells, dark grey for cells far above the median; black is kept for the path."""
    filled = ink[ink > 0]
    median = float(np.median(filled)) if filled.size else 1.0
    share = np.ceil(_GREYS * ink / (ink + median)) / _GREYS
    return np.asarray(np.where(ink > 0, 225 - 145 * share, 255), np.uint8)


def _frame(sheet: _PlanArea) -> Iterator[str]:
    """Yield border, ticks in metres and a scale bar."""
    (left, bottom), (right, top) = sheet.px(*sheet.low), sheet.px(*sheet.high)
    step = round_step(90.0 / sheet.px_per_m)
    yield f"<path class='axis' d='M{coord(left)} {coord(top)}H{coord(right)}V{coord(bottom)}H{coord(left)}z'/>"
    for x_m in _ticks(sheet.low[0], sheet.high[0], step):
        x, _ = sheet.px(x_m, 0)
        yield f"<path class='axis' d='M{coord(x)} {coord(bottom)}v5'/>"
        yield text((x, bottom + 18), label(x_m), "text-anchor='middle'")
    for y_m in _ticks(sheet.low[1], sheet.high[1], step):
        _, y = sheet.px(0, y_m)
        yield f"<path class='axis' d='M{coord(left)} {coord(y)}h-5'/>"
        yield text((left - 8, y + 4), label(y_m), "text-anchor='end'")
    yield text(((left + right) / 2, bottom + 36), "x, forward at the start [m]", "text-anchor='middle'")
    yield text((4, top - 8), "y, to the left [m]")
    bar = step * sheet.px_per_m
    yield f"<rect x='{coord(right - bar)}' y='{coord(top - 12)}' width='{coord(bar)}' height='5'/>"
    yield text((right - bar - 6, top - 7), f"{label(step)} m", "text-anchor='end'")


def _ticks(low: float, high: float, step: float) -> list[float]:
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _line(sheet: _PlanArea, points: Sequence[Point], style: str) -> Iterator[str]:
    if points:
        yield f"<path class='halo' d='{path_d(sheet.px(*at) for at in points)}'/>"
        yield polyline([sheet.px(*at) for at in points], f"class='{style}'")


def _runs(corners: Sequence[Corner], restarts_s: Sequence[float]) -> list[list[Corner]]:
    """Return the vertices of each run of the daemon: no line leads from one odom to the next."""
    return [list(run) for _, run in groupby(corners, lambda corner: bisect_right(restarts_s, corner.t_s))]


def _path(sheet: _PlanArea, runs: Sequence[Sequence[Corner]]) -> Iterator[str]:
    """Yield one line for each stretch of the same state, which starts at the end of the previous one of its run."""
    at = [[sheet.px(corner.x_m, corner.y_m) for corner in run] for run in runs]
    times = " ".join(f"{corner.t_s:.2f}" for run in runs for corner in run)
    yield f"<path class='halo' d='{''.join(map(path_d, at))}' data-t='{times}'/>"
    for places, run in zip(at, runs, strict=True):
        yield from _stretches(places, [max(corner.rank, 0) for corner in run])


def _stretches(places: Sequence[Point], ranks: Sequence[int]) -> Iterator[str]:
    for rank, group in groupby(range(1, len(places)), ranks.__getitem__):
        indices = list(group)
        yield polyline(places[indices[0] - 1 : indices[-1] + 1], f"class='p{rank}'")


def _times(sheet: _PlanArea, corners: Sequence[Corner], clock: Clock) -> Iterator[str]:
    """Yield dots with the time, which relate the path to the charts."""
    seconds, unit = clock.unit
    step_s = round_step(max((clock.end_s - clock.start_s) / seconds, 1e-3) / _TIME_MARKS) * seconds
    due_s = corners[0].t_s + step_s
    for corner in corners[1:-1]:
        if corner.t_s >= due_s - 1e-6:
            x, y = sheet.px(corner.x_m, corner.y_m)
            yield f"<circle cx='{coord(x)}' cy='{coord(y)}' r='3.4' fill='#fff' stroke='#111'/>"
            yield text((x + 7, y - 6), f"{label(round(due_s / seconds, 9))} {unit}", "class='over'")
            due_s += step_s * math.ceil((corner.t_s - due_s + 1e-6) / step_s)


def _cross(x: float, y: float) -> str:
    return f"<path d='M{coord(x - 6)} {coord(y - 6)}l12 12m0 -12l-12 12' stroke='#111' stroke-width='2.5'/>"


def _ends(sheet: _PlanArea, corners: Sequence[Corner]) -> Iterator[str]:
    """Yield a ring at the start and a square at the end."""
    (x0, y0), (x1, y1) = (sheet.px(c.x_m, c.y_m) for c in (corners[0], corners[-1]))
    yield f"<rect x='{coord(x1 - 6)}' y='{coord(y1 - 6)}' width='12' height='12' stroke='#fff' stroke-width='2'/>"
    yield f"<circle cx='{coord(x0)}' cy='{coord(y0)}' r='6' fill='#fff' stroke='#111' stroke-width='3'/>"
    below = 22 if y1 >= y0 else -12
    yield text((x0, y0 - below + 8), "start", "text-anchor='middle' class='over'")
    yield text((x1, y1 + below), "end", "text-anchor='middle' class='over'")


STYLE: Final = """.p0,.p1,.p2,.pt,.pm,.halo{fill:none;stroke-linejoin:round;stroke:#111;stroke-width:2.6}
.p1{stroke-dasharray:9 4}.p2{stroke-dasharray:2.5 3.5}.pt{stroke:#666;stroke-width:1.4;stroke-dasharray:5 3}
.pm{stroke:#06c;stroke-width:1.8}
.halo{stroke:#fff;stroke-width:6}text.over{paint-order:stroke;stroke:#fff;stroke-width:3px;stroke-linejoin:round}
.track{fill:#ececec}"""
