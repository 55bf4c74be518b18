"""The path over the map, from above: x (forward) to the right, y (left) up, in metres."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.report.chart import Clock
from omnid.report.downsampling import Corner
from omnid.report.svg import Point, key, label, mark_key, number, path_d, polyline, round_step, text

Array = NDArray[np.float64]

Z_M: Final = (-1.0, 1.5)  # heights that are drawn, from the rig's at the start
_SIDE_PX: Final = (1000.0, 760.0)
_LEAST_M: Final = 1.0
_MOST_PX_PER_M: Final = 400.0
_MARGIN: Final = (44.0, 26.0, 14.0, 44.0)  # left, top, right, bottom [px]
_CELL_M: Final = 0.05  # the map's usual voxel
_TIMES: Final = 6  # marks along the path
_GREYS: Final = 12  # so few that the image stays small


@dataclass(frozen=True, slots=True)
class Plan:
    """What is drawn."""

    corners: Sequence[Corner]
    points: NDArray[np.float32]  # (N, 3) m, of the map
    confidence: NDArray[np.float32]  # (N,)
    height_m: float  # of the rig at the start
    truth: Sequence[Point] = ()  # x, y of the true path
    lost: Sequence[Point] = ()  # where the pose was lost


@dataclass(frozen=True, slots=True)
class _Sheet:
    low: Point  # m
    high: Point
    px_per_m: float

    def px(self, x_m: float, y_m: float) -> Point:
        return (_MARGIN[0] + (x_m - self.low[0]) * self.px_per_m, _MARGIN[1] + (self.high[1] - y_m) * self.px_per_m)

    @property
    def size(self) -> Point:
        return ((self.high[0] - self.low[0]) * self.px_per_m, (self.high[1] - self.low[1]) * self.px_per_m)


def plan_figure(plan: Plan, clock: Clock) -> str:
    """The figure."""
    inside = np.abs(plan.points[:, 2] - plan.height_m - sum(Z_M) / 2) <= (Z_M[1] - Z_M[0]) / 2
    places, sureness = plan.points[inside, :2].astype(float), plan.confidence[inside]
    sheet = _sheet([*((c.x_m, c.y_m) for c in plan.corners), *plan.truth], places)
    width, height = sheet.size
    parts = [*_map(sheet, places, sureness), *_frame(sheet), *_truth(sheet, plan.truth), *_path(sheet, plan.corners),
             *_times(sheet, plan.corners, clock), *(_cross(*sheet.px(*at)) for at in plan.lost),
             *_ends(sheet, plan.corners)]
    box = f"0 0 {number(width + _MARGIN[0] + _MARGIN[2])} {number(height + _MARGIN[1] + _MARGIN[3])}"
    return (f"<figure class='plan'><figcaption><b>Path and map</b> {_keys(plan)}</figcaption><svg viewBox='{box}' "
            f"role='img' aria-label='Path and map'>{''.join(parts)}</svg><small>{_remark(plan, len(places))}</small>"
            "</figure>")


def _keys(plan: Plan) -> str:
    ranks = {max(corner.rank, 0) for corner in plan.corners[1:]}
    names = ("the path, tracking", "degraded", "lost")
    known = any(corner.rank >= 0 for corner in plan.corners)
    shown = [key(f"class='p{rank}'", names[rank] if known else "the path") for rank in sorted(ranks)]
    shown += [mark_key(_cross(17, 6), "lost here")] if plan.lost else []
    return "".join([*shown, *([key("class='pt'", "the true path")] if plan.truth else [])])


def _remark(plan: Plan, drawn: int) -> str:
    if not len(plan.points):
        return "The log holds no map that could be drawn beneath it."
    low, high = Z_M
    return (f"Grey: {drawn} of the map's {len(plan.points)} points, those from {-low:g} m below the rig's height at "
            f"the start to {high:g} m above it; the darker, the surer and the more of them stand above one another.")


def _sheet(path: Sequence[Point], places: Array) -> _Sheet:
    """The area that holds the path and the bulk of the points: a few false far points must not shrink the rooms."""
    corners = np.array(path)
    if len(places):
        near = np.abs(places).max(axis=1) <= 1e6
        corners = np.vstack([corners, np.quantile(places[near], [0.005, 0.995], axis=0)] if near.any() else [corners])
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = np.maximum(0.53 * (high - low), _LEAST_M / 2)
    half = np.maximum(half, 0.15 * half.max())
    centre = (low + high) / 2
    px_per_m = min(_MOST_PX_PER_M, *(side / (2 * float(h)) for side, h in zip(_SIDE_PX, half, strict=True)))
    (x0, y0), (x1, y1) = centre - half, centre + half
    return _Sheet((float(x0), float(y0)), (float(x1), float(y1)), px_per_m)


def _map(sheet: _Sheet, places: Array, confidence: NDArray[np.float32]) -> Iterator[str]:
    """The points as a grey image, one of its pixels for a cell of the map or a pixel of the page."""
    if not len(places):
        return
    cell_m = max(_CELL_M, 1.25 / sheet.px_per_m)
    counts = [math.ceil((high - low) / cell_m) for low, high in zip(sheet.low, sheet.high, strict=True)]
    sides = [(low, low + count * cell_m) for low, count in zip(sheet.low, counts, strict=True)]
    weights = np.clip(np.nan_to_num(confidence), 0.0, 1.0)
    ink = np.histogram2d(places[:, 0], places[:, 1], counts, sides, weights=weights)[0].T[::-1]
    png = cv2.imencode(".png", _tone(ink), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]
    (left, top), (right, bottom) = sheet.px(sides[0][0], sides[1][1]), sheet.px(sides[0][1], sides[1][0])
    yield (f"<image x='{number(left)}' y='{number(top)}' width='{number(right - left)}' "
           f"height='{number(bottom - top)}' preserveAspectRatio='none' style='image-rendering:pixelated' "
           f"href='data:image/png;base64,{base64.b64encode(png.tobytes()).decode()}'/>")


def _tone(ink: Array) -> NDArray[np.uint8]:
    """Greys: white for nothing, towards a dark one for cells well above the usual; black is the path's."""
    filled = ink[ink > 0]
    usual = float(np.median(filled)) if filled.size else 1.0
    share = np.ceil(_GREYS * ink / (ink + usual)) / _GREYS
    return np.asarray(np.where(ink > 0, 225 - 145 * share, 255), np.uint8)


def _frame(sheet: _Sheet) -> Iterator[str]:
    """Border, ticks in metres and a scale bar."""
    (left, bottom), (right, top) = sheet.px(*sheet.low), sheet.px(*sheet.high)
    step = round_step(90.0 / sheet.px_per_m)
    yield f"<path class='axis' d='M{number(left)} {number(top)}H{number(right)}V{number(bottom)}H{number(left)}z'/>"
    for x_m in _ticks(sheet.low[0], sheet.high[0], step):
        x, _ = sheet.px(x_m, 0)
        yield f"<path class='axis' d='M{number(x)} {number(bottom)}v5'/>"
        yield text((x, bottom + 18), label(x_m), "text-anchor='middle'")
    for y_m in _ticks(sheet.low[1], sheet.high[1], step):
        _, y = sheet.px(0, y_m)
        yield f"<path class='axis' d='M{number(left)} {number(y)}h-5'/>"
        yield text((left - 8, y + 4), label(y_m), "text-anchor='end'")
    yield text(((left + right) / 2, bottom + 36), "x, forward at the start [m]", "text-anchor='middle'")
    yield text((4, top - 8), "y, to the left [m]")
    bar = step * sheet.px_per_m
    yield f"<rect x='{number(right - bar)}' y='{number(top - 12)}' width='{number(bar)}' height='5'/>"
    yield text((right - bar - 6, top - 7), f"{label(step)} m", "text-anchor='end'")


def _ticks(low: float, high: float, step: float) -> list[float]:
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _truth(sheet: _Sheet, truth: Sequence[Point]) -> Iterator[str]:
    if truth:
        yield f"<path class='halo' d='{path_d(sheet.px(*at) for at in truth)}'/>"
        yield polyline([sheet.px(*at) for at in truth], "class='pt'")


def _path(sheet: _Sheet, corners: Sequence[Corner]) -> Iterator[str]:
    """One line for each stretch of the same state; it reaches back to where the one before ends."""
    at = [sheet.px(corner.x_m, corner.y_m) for corner in corners]
    yield f"<path class='halo' d='{path_d(at)}'/>"
    for rank, group in groupby(range(1, len(corners)), lambda k: max(corners[k].rank, 0)):
        indices = list(group)
        yield polyline(at[indices[0] - 1 : indices[-1] + 1], f"class='p{rank}'")


def _times(sheet: _Sheet, corners: Sequence[Corner], clock: Clock) -> Iterator[str]:
    """Dots with the time, so that the path and the charts can be read together."""
    seconds, unit = clock.unit
    step_s = round_step(max((clock.end_s - clock.start_s) / seconds, 1e-3) / _TIMES) * seconds
    due_s = corners[0].t_s + step_s
    for corner in corners[1:-1]:
        if corner.t_s >= due_s - 1e-6:
            x, y = sheet.px(corner.x_m, corner.y_m)
            yield f"<circle cx='{number(x)}' cy='{number(y)}' r='3.4' fill='#fff' stroke='#111'/>"
            yield text((x + 7, y - 6), f"{label(round(due_s / seconds, 9))} {unit}", "class='over'")
            due_s += step_s * math.ceil((corner.t_s - due_s + 1e-6) / step_s)


def _cross(x: float, y: float) -> str:
    return f"<path d='M{number(x - 6)} {number(y - 6)}l12 12m0 -12l-12 12' stroke='#111' stroke-width='2.5'/>"


def _ends(sheet: _Sheet, corners: Sequence[Corner]) -> Iterator[str]:
    """A ring where it starts, a square where it ends."""
    (x0, y0), (x1, y1) = (sheet.px(c.x_m, c.y_m) for c in (corners[0], corners[-1]))
    yield f"<rect x='{number(x1 - 6)}' y='{number(y1 - 6)}' width='12' height='12' stroke='#fff' stroke-width='2'/>"
    yield f"<circle cx='{number(x0)}' cy='{number(y0)}' r='6' fill='#fff' stroke='#111' stroke-width='3'/>"
    below = 22 if y1 >= y0 else -12
    yield text((x0, y0 - below + 8), "start", "text-anchor='middle' class='over'")
    yield text((x1, y1 + below), "end", "text-anchor='middle' class='over'")


STYLE: Final = """.p0,.p1,.p2,.pt,.halo{fill:none;stroke-linejoin:round;stroke:#111;stroke-width:2.6}
.p1{stroke-dasharray:9 4}.p2{stroke-dasharray:2.5 3.5}.pt{stroke:#666;stroke-width:1.4;stroke-dasharray:5 3}
.halo{stroke:#fff;stroke-width:6}text.over{paint-order:stroke;stroke:#fff;stroke-width:3px;stroke-linejoin:round}
.track{fill:#ececec}"""
