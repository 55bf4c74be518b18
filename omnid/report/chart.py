"""Charts over time, all with the same time axis and the same shades for the states."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import cycle, pairwise
from typing import Final, NamedTuple, TypeAlias

from omnid.report.downsampling import Downsampled
from omnid.report.svg import (
    STYLES,
    Axis,
    Point,
    axis_for,
    coord,
    hidden,
    key,
    label,
    pieces,
    polyline,
    rectangles,
    text,
)

WIDTH: Final = 520
HEIGHT: Final = 190
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 510, 8, 158
_UNITS: Final = ((300.0, 1.0, "s"), (10800.0, 60.0, "min"), (float("inf"), 3600.0, "h"))

Spans: TypeAlias = tuple[list[Point], ...]  # of tracking, degraded and lost, as poses.STATES


class ChartLine(NamedTuple):
    """A curve of a chart; each has a style of its own."""

    name: str
    points: Sequence[Point]


def curve(name: str, series: Downsampled) -> ChartLine:
    """Return a series as a curve."""
    return ChartLine(name, series.points())


@dataclass(frozen=True, slots=True)
class Clock:
    """The time range that is shown, s since the first pose, and its unit."""

    start_s: float
    end_s: float

    @property
    def unit(self) -> tuple[float, str]:
        """Length of the unit in seconds, and its name."""
        return next((seconds, name) for most, seconds, name in _UNITS if self.end_s - self.start_s <= most)

    def axis(self, start_px: float, end_px: float) -> Axis:
        """Return the axis of the time range, in the unit."""
        seconds, _ = self.unit
        return Axis(self.start_s / seconds, self.end_s / seconds, start_px, end_px)

    def column(self, start_px: float, end_px: float) -> Callable[[float], float]:
        """Return the function from a time [s] to its column [px], with the time range between two columns."""
        axis, (seconds, _) = self.axis(start_px, end_px), self.unit
        return lambda t_s: axis.px(t_s / seconds)

    def shown(self, points: Sequence[Point]) -> list[Point]:
        """Return the points within the time range, with times in the unit."""
        seconds, _ = self.unit
        return [(t / seconds, value) for t, value in points if self.start_s <= t <= self.end_s]


def spans_of(states: Sequence[Point], end_s: float) -> Spans:
    """Return start and end [s] of each state from points (time, rank); a state lasts until the next one."""
    found: Spans = ([], [], [])
    for (t, rank), (until, _) in pairwise([*states, (end_s, 0.0)]):
        spans = found[int(rank)]
        if spans and spans[-1][1] == t:
            spans[-1] = (spans[-1][0], until)
        else:
            spans.append((t, until))
    return found


def shades(spans: Spans, clock: Clock) -> str:
    """Return the background of all charts, to be put into the page once."""
    seconds, _ = clock.unit
    axis = clock.axis(_LEFT, _RIGHT)
    px = clock.column(_LEFT, _RIGHT)
    areas = (rectangles([(px(a), px(b)) for a, b in spans[rank]], (_TOP, _BOTTOM)) for rank in (1, 2))
    drawn = "".join(f"<path class='r{rank}' d='{d}'/>" for rank, d in enumerate(areas, 1) if d)
    for_script = (
        f"data-clock='{axis.low!r} {axis.high!r} {seconds!r}' data-unit='{clock.unit[1]}' "
        f"data-box='{_LEFT} {_RIGHT} {_TOP} {_BOTTOM}'"
    )
    inside = f"<rect x='{_LEFT}' y='{_TOP}' width='{_RIGHT - _LEFT}' height='{_BOTTOM - _TOP}'/>"
    return hidden(f"<clipPath id='inside'>{inside}</clipPath><g id='shades' {for_script}>{drawn}</g>")


def chart(
    title: str,
    lines: Sequence[ChartLine],
    clock: Clock,
    *,
    unit: str = "",
    log: bool = False,
    zero: bool = False,
    note: str = "",
) -> str:
    """Return a figure with curves over time; "" where all are empty."""
    shown = [ChartLine(name, [p for p in clock.shown(points) if p[1] > 0 or not log]) for name, points in lines]
    styled = list(zip(cycle(STYLES), (drawn for drawn in shown if drawn.points), strict=False))
    if not styled:
        return ""
    x = clock.axis(_LEFT, _RIGHT)
    y = axis_for([value for _, drawn in styled for _, value in drawn.points], (_BOTTOM, _TOP), log=log, zero=zero)
    curves = "".join(_curve(style, drawn, x, y) for style, drawn in styled)
    keys = "".join(key(style, drawn.name) for style, drawn in styled if drawn.name)
    caption = f"<b>{escape(title)}</b>{f' [{escape(unit)}]' if unit else ''} {keys}"
    footnote = f"<small>{escape(note)}</small>" if note else ""
    plot = f"<g clip-path='url(#inside)'><g class='zoom'><use href='#shades'/>{curves}</g></g>"
    image = "".join([*_grid(x, y), plot, *_frame(x, y, clock)])
    return (
        f"<figure class='chart'><figcaption>{caption}</figcaption><svg viewBox='0 0 {WIDTH} {HEIGHT}' role='img' "
        f"aria-label='{escape(title)}' data-y='{y.low!r} {y.high!r} {int(y.log)}'>{image}</svg>{footnote}</figure>"
    )


def _curve(style: str, line: ChartLine, x: Axis, y: Axis) -> str:
    drawn = [polyline([(x.px(t), y.px(value)) for t, value in piece], style) for piece in pieces(line.points)]
    return f"<g data-name='{escape(line.name)}'>{''.join(drawn)}</g>"


def _grid(x: Axis, y: Axis) -> Iterator[str]:
    rows = "".join(f"M{_LEFT} {coord(y.px(v))}H{_RIGHT}" for v in y.ticks(5))
    columns = "".join(f"M{coord(x.px(v))} {_TOP}V{_BOTTOM}" for v in x.ticks(8))
    yield f"<path class='grid' d='{rows}'/><path class='grid columns' d='{columns}'/>"


def _frame(x: Axis, y: Axis, clock: Clock) -> Iterator[str]:
    for value in y.ticks(5):
        yield text((_LEFT - 5, y.px(value) + 4), label(value), "text-anchor='end'")
    yield f"<path class='axis' d='M{_LEFT} {_TOP}V{_BOTTOM}H{_RIGHT}'/>"
    yield f"<g class='time'>{''.join(time_ticks(x, float(_BOTTOM), clock))}</g>"


def time_ticks(x: Axis, bottom: float, clock: Clock) -> Iterator[str]:
    """Yield ticks with their times, below a row [px]."""
    ticks = x.ticks(8)
    yield f"<path class='axis' d='{''.join(f'M{coord(x.px(v))} {coord(bottom)}v4' for v in ticks)}'/>"
    for value in ticks:
        last = value == ticks[-1]
        words = f"{label(value)} {clock.unit[1]}" if last else label(value)
        yield text((x.px(value), bottom + 17), words, "text-anchor='end'" if last else "text-anchor='middle'")
