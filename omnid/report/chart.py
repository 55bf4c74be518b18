"""Charts over time, all with the same axis of time and the same shades for the states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import Final, NamedTuple, TypeAlias

from omnid.report.events import ERROR, GOOD, WARNING, Event
from omnid.report.svg import (
    STYLES,
    Axis,
    Point,
    area_key,
    axis_for,
    hidden,
    key,
    label,
    mark_key,
    number,
    pieces,
    polyline,
    rectangles,
    text,
)
from omnid.report.thinned import Thinned

WIDTH: Final = 520
HEIGHT: Final = 190
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 510, 8, 158
_WIDE_LEFT, _WIDE_RIGHT, _LANE = 124, 1030, 26
_LANES: Final = 14
_FILLS: Final = ("class='track box'", "class='r1 box'", "class='r2 box'")
_UNITS: Final = ((300.0, 1.0, "s"), (10800.0, 60.0, "min"), (float("inf"), 3600.0, "h"))


Spans: TypeAlias = tuple[list[Point], ...]  # of tracking, degraded and lost, as poses.STATES


class Line(NamedTuple):
    """A course to draw; each of a chart has a style of its own."""

    name: str
    points: Sequence[Point]


def line(name: str, course: Thinned) -> Line:
    """A course as a line."""
    return Line(name, course.points())


@dataclass(frozen=True, slots=True)
class Clock:
    """The time that is shown, s since the first pose, and in what unit."""

    start_s: float
    end_s: float

    @property
    def unit(self) -> tuple[float, str]:
        """Seconds in it, and its name."""
        return next((seconds, name) for most, seconds, name in _UNITS if self.end_s - self.start_s <= most)

    def axis(self, start_px: float, end_px: float) -> Axis:
        """Values are in the unit."""
        seconds, _ = self.unit
        return Axis(self.start_s / seconds, self.end_s / seconds, start_px, end_px)

    def shown(self, points: Sequence[Point]) -> list[Point]:
        """Those of the points within the time, in the unit."""
        seconds, _ = self.unit
        return [(t / seconds, value) for t, value in points if self.start_s <= t <= self.end_s]


def spans_of(states: Sequence[Point], end_s: float) -> Spans:
    """From when to when [s] the odometry was in each state, out of ranks at times: a state holds until the next one."""
    found: Spans = ([], [], [])
    for (t, rank), (until, _) in pairwise([*states, (end_s, 0.0)]):
        spans = found[int(rank)]
        if spans and spans[-1][1] == t:
            spans[-1] = (spans[-1][0], until)
        else:
            spans.append((t, until))
    return found


def shades(spans: Spans, clock: Clock) -> str:
    """The background of all charts, to be put into the page once."""
    seconds, _ = clock.unit
    axis = clock.axis(_LEFT, _RIGHT)
    areas = (rectangles([(axis.px(a / seconds), axis.px(b / seconds)) for a, b in spans[rank]],
                        (_TOP, _BOTTOM)) for rank in (1, 2))
    drawn = "".join(f"<path class='r{rank}' d='{d}'/>" for rank, d in enumerate(areas, 1) if d)
    return hidden(f"<g id='shades'>{drawn}</g>")


def chart(title: str, lines: Sequence[Line], clock: Clock, *, unit: str = "", log: bool = False, zero: bool = False,
          note: str = "") -> str:
    """A figure with some courses over time; "" where there is nothing to draw."""
    shown = [Line(line.name, clock.shown(line.points)) for line in lines]
    if log:
        shown = [Line(line.name, [p for p in line.points if p[1] > 0]) for line in shown]
    shown = [line for line in shown if line.points]
    if not shown:
        return ""
    values = [value for line in shown for _, value in line.points]
    y = axis_for(values, (_BOTTOM, _TOP), log=log, zero=zero)
    x = clock.axis(_LEFT, _RIGHT)
    drawn = [polyline([(x.px(t), y.px(v)) for t, v in piece], STYLES[k % len(STYLES)])
             for k, line in enumerate(shown) for piece in pieces(line.points)]
    keys = "".join(key(STYLES[k % len(STYLES)], line.name) for k, line in enumerate(shown)) if len(shown) > 1 or \
        shown[0].name else ""
    caption = f"<b>{escape(title)}</b>{f' [{escape(unit)}]' if unit else ''} {keys}"
    remark = f"<small>{escape(note)}</small>" if note else ""
    picture = "".join([*_grid(x, y), "<use href='#shades'/>", *_frame(x, y, clock), *drawn])
    return (f"<figure class='chart'><figcaption>{caption}</figcaption><svg viewBox='0 0 {WIDTH} {HEIGHT}' role='img' "
            f"aria-label='{escape(title)}'>{picture}</svg>{remark}</figure>")


def timeline(spans: Spans, gaps: Sequence[Point], events: Sequence[Event], clock: Clock) -> str:
    """The states as a band, and below it a lane of marks for everyone that something happened to."""
    sources = sorted({event.source for event in events} - {"state", "poses"}, key=lambda s: ("stage" in s, s))[:_LANES]
    seconds, _ = clock.unit
    x, height = clock.axis(_WIDE_LEFT, _WIDE_RIGHT), 42 + _LANE * len(sources)
    parts = [text((_WIDE_LEFT - 8, 27), "state", "text-anchor='end'"),
             f"<rect class='none' x='{_WIDE_LEFT}' y='8' width='{_WIDE_RIGHT - _WIDE_LEFT}' height='28'/>"]
    for rank, style in enumerate(_FILLS):
        d = rectangles([(x.px(a / seconds), x.px(b / seconds)) for a, b in spans[rank]], (8, 36))
        parts.append(f"<path {style} d='{d}'/>" if d else "")
    missing = [(x.px(a / seconds), x.px(b / seconds)) for a, b in gaps]
    parts.append(f"<path class='none' d='{rectangles(missing, (8, 36))}'/>")
    parts += [_reset(x.px(event.start_s / seconds), 19) for event in events if _is_reset(event)]
    for row, source in enumerate(sources):
        parts += _lane(source, 42 + _LANE * row, [e for e in events if e.source == source], (x, seconds))
    parts += _time_ticks(x, float(height), clock)
    names = ("tracking", "degraded", "lost", "no pose, or its state is not told")
    keys = [area_key(style, name) for style, name in zip((*_FILLS, "class='none'"), names, strict=True)]
    keys += [mark_key(mark(level, 17, 6), name) for level, name in ((GOOD, "news"), (WARNING, "warning"),
                                                                    (ERROR, "error")) if sources]
    keys += [mark_key(_reset(17, 12), "reset")] if any(map(_is_reset, events)) else []
    return (f"<figure class='lanes'><figcaption><b>States and events</b> {''.join(keys)}</figcaption>"
            f"<svg viewBox='0 0 1040 {height + 34}' role='img' aria-label='States and events'>{''.join(parts)}</svg>"
            "</figure>")


def _is_reset(event: Event) -> bool:
    return event.source == "state" and event.level == ERROR and event.text != "lost"


def _reset(x: float, bottom: float) -> str:
    """A black arrow that points down."""
    return f"<path d='M{number(x)} {number(bottom)}l-5.5 -11h11z' fill='#000'/>"


def _lane(source: str, top: float, events: Sequence[Event], axis: tuple[Axis, float]) -> Iterator[str]:
    x, seconds = axis
    middle = top + _LANE / 2
    yield text((_WIDE_LEFT - 8, middle + 4), source[:18], "text-anchor='end'")
    yield f"<path class='grid' d='M{_WIDE_LEFT} {number(middle)}H{_WIDE_RIGHT}'/>"
    for event in events:
        a, b = x.px(event.start_s / seconds), x.px(event.end_s / seconds)
        if b - a > 3:
            yield f"<path d='M{number(a)} {number(middle)}H{number(b)}' stroke='#555' stroke-width='5'/>"
        yield mark(event.level, a, middle)


def mark(level: int, x: float, y: float) -> str:
    """A ring for news that are good, a triangle for a warning, a black square for an error."""
    if level == GOOD:
        return f"<circle cx='{number(x)}' cy='{number(y)}' r='4' fill='#fff' stroke='#111'/>"
    if level == ERROR:
        return f"<rect x='{number(x - 4.5)}' y='{number(y - 4.5)}' width='9' height='9' fill='#111'/>"
    return f"<path d='M{number(x)} {number(y - 5.5)}l5.5 10h-11z' fill='#fff' stroke='#111' stroke-width='1.4'/>"


def _grid(x: Axis, y: Axis) -> Iterator[str]:
    rows = "".join(f"M{_LEFT} {number(y.px(v))}H{_RIGHT}" for v in y.ticks(5))
    columns = "".join(f"M{number(x.px(v))} {_TOP}V{_BOTTOM}" for v in x.ticks(8))
    yield f"<path class='grid' d='{rows}{columns}'/>"


def _frame(x: Axis, y: Axis, clock: Clock) -> Iterator[str]:
    for value in y.ticks(5):
        yield text((_LEFT - 5, y.px(value) + 4), label(value), "text-anchor='end'")
    yield f"<path class='axis' d='M{_LEFT} {_TOP}V{_BOTTOM}H{_RIGHT}'/>"
    yield from _time_ticks(x, float(_BOTTOM), clock)


def _time_ticks(x: Axis, bottom: float, clock: Clock) -> Iterator[str]:
    ticks = x.ticks(8)
    yield f"<path class='axis' d='{''.join(f'M{number(x.px(v))} {number(bottom)}v4' for v in ticks)}'/>"
    for value in ticks:
        last = value == ticks[-1]
        words = f"{label(value)} {clock.unit[1]}" if last else label(value)
        yield text((x.px(value), bottom + 17), words, "text-anchor='end'" if last else "text-anchor='middle'")
