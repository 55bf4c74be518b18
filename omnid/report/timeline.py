"""A figure with the states of the odometry as a band, and a lane of events for each part below it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final

from omnid.report.chart import Clock, Spans, time_ticks
from omnid.report.events import ERROR, GOOD, Event
from omnid.report.svg import Point, area_key, coord, mark_key, rectangles, text

_LEFT, _RIGHT, _BAND, _LANE = 124, 1030, (8, 36), 26
_LANES: Final = 14
_FILLS: Final = ("class='track box'", "class='r1 box'", "class='r2 box'")
_MISSING: Final = "class='none'"


def timeline(spans: Spans, gaps: Sequence[Point], events: Sequence[Event], clock: Clock) -> str:
    """Return the figure; parts without events have no lane."""
    sources = sorted({event.source for event in events} - {"state", "poses"}, key=lambda s: ("stage" in s, s))[:_LANES]
    px, height = clock.column(_LEFT, _RIGHT), 42 + _LANE * len(sources)
    parts = [
        *_band(spans, gaps, clock),
        *(_reset(px(event.start_s), 19) for event in events if _is_reset(event)),
    ]
    for row, source in enumerate(sources):
        parts += _lane(source, 42 + _LANE * row, [e for e in events if e.source == source], px)
    parts += time_ticks(clock.axis(_LEFT, _RIGHT), float(height), clock)
    return (
        f"<figure class='lanes'><figcaption><b>States and events</b> {_keys(events, bool(sources))}</figcaption><svg "
        f"viewBox='0 0 1040 {height + 34}' role='img' aria-label='States and events' data-x='{_LEFT} "
        f"{_RIGHT}'>{''.join(parts)}</svg></figure>"
    )


def _band(spans: Spans, gaps: Sequence[Point], clock: Clock) -> Iterator[str]:
    """Yield the band; the states cover the style that means unknown."""
    px = clock.column(_LEFT, _RIGHT)
    yield text((_LEFT - 8, 27), "state", "text-anchor='end'")
    for style, found in (
        (_MISSING, [(clock.start_s, clock.end_s)]),
        *zip(_FILLS, spans, strict=True),
        (_MISSING, gaps),
    ):
        d = rectangles([(px(a), px(b)) for a, b in found], _BAND)
        yield f"<path {style} d='{d}'/>" if d else ""


def _keys(events: Sequence[Event], lanes: bool) -> str:
    keys = [
        area_key(style, name)
        for style, name in zip(
            (*_FILLS, _MISSING), ("tracking", "degraded", "lost", "no pose, or its state is unknown"), strict=True
        )
    ]
    if lanes:
        keys += [mark_key(_mark(level, 17, 6), name) for level, name in enumerate(("change", "warning", "error"))]
    if any(map(_is_reset, events)):
        keys.append(mark_key(_reset(17, 12), "reset"))
    return "".join(keys)


def _is_reset(event: Event) -> bool:
    return event.source == "state" and event.level == ERROR and event.text != "lost"


def _reset(x: float, bottom: float) -> str:
    """Return a black arrow that points down."""
    return f"<path d='M{coord(x)} {coord(bottom)}l-5.5 -11h11z' fill='#000'/>"


def _lane(source: str, top: float, events: Sequence[Event], px: Callable[[float], float]) -> Iterator[str]:
    """Yield the events of a source in a row of its own; px: the column [px] of a time [s]."""
    middle = top + _LANE / 2
    yield text((_LEFT - 8, middle + 4), source[:18], "text-anchor='end'")
    yield f"<path class='grid' d='M{_LEFT} {coord(middle)}H{_RIGHT}'/>"
    for event in events:
        a, b = px(event.start_s), px(event.end_s)
        if b - a > 3:
            yield f"<path d='M{coord(a)} {coord(middle)}H{coord(b)}' stroke='#555' stroke-width='5'/>"
        yield _mark(event.level, a, middle)


def _mark(level: int, x: float, y: float) -> str:
    """Return a ring for a good event, a triangle for a warning, a black square for an error."""
    if level == GOOD:
        return f"<circle cx='{coord(x)}' cy='{coord(y)}' r='4' fill='#fff' stroke='#111'/>"
    if level == ERROR:
        return f"<rect x='{coord(x - 4.5)}' y='{coord(y - 4.5)}' width='9' height='9' fill='#111'/>"
    return f"<path d='M{coord(x)} {coord(y - 5.5)}l5.5 10h-11z' fill='#fff' stroke='#111' stroke-width='1.4'/>"
