"""Elements of SVG figures; lines differ by dashes and greys, so that a black and white print can be read."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import Final

Point = tuple[float, float]

STYLES: Final = ("class='l0'", "class='l1'", "class='l2'", "class='l3'", "class='l4'", "class='l5'")
STYLE: Final = """svg{display:block;width:100%;height:auto}svg text{font:12px system-ui,sans-serif;fill:#222}
.l0,.l1,.l2,.l3,.l4,.l5{fill:none;stroke-linejoin:round;stroke-linecap:butt;stroke-width:1.7}
.l0{stroke:#111}.l1{stroke:#555;stroke-dasharray:7 3}.l2{stroke:#111;stroke-dasharray:2 2.5}.l3{stroke:#999;
stroke-width:2.6}.l4{stroke:#333;stroke-dasharray:9 3 2 3}.l5{stroke:#777;stroke-dasharray:3 5}
.axis{stroke:#333;stroke-width:1;fill:none}.grid{stroke:#ddd;stroke-width:1;fill:none}
.r1{fill:url(#weak)}.r2{fill:url(#gone)}.none{fill:#fff;stroke:#555;stroke-width:1;stroke-dasharray:2 2}
.box{stroke:#555;stroke-width:.8}
.plan>svg text{font-size:calc(12px*var(--px,1))}.plan>svg circle{r:calc(5px*var(--px,1))}
.zoom path,.plan>svg path,.plan>svg circle{vector-effect:non-scaling-stroke}
.chart svg,.lanes>svg,.plan>svg{touch-action:pan-y;user-select:none;-webkit-user-select:none}
.chart>svg,.lanes>svg,.plan>svg{cursor:crosshair}.drag{fill:#06c;fill-opacity:.15;pointer-events:none}
.cursor{stroke:#06c;stroke-width:1;pointer-events:none}.robot{fill:#06c;stroke:#fff;stroke-width:2;pointer-events:none}
output{display:block;position:relative;height:0;text-align:right;color:#048;font-size:.85em;pointer-events:none}
output span{background:#fffd;padding:0 .3em}
.hint{color:#555;font-size:.9em;margin:.2em 0}.all{position:fixed;right:1em;bottom:1em;padding:.5em 1em;font:inherit}
@media print{.hint,.all,output{display:none}}"""
PATTERNS: Final = """<pattern id="weak" width="7" height="7" patternUnits="userSpaceOnUse"
patternTransform="rotate(45)"><rect width="7" height="7" fill="#fff"/>
<path d="M0 0V7" stroke="#a8a8a8" stroke-width="1.6"/></pattern>
<pattern id="gone" width="5" height="5" patternUnits="userSpaceOnUse">
<rect width="5" height="5" fill="#d2d2d2"/><path d="M0 0L5 5M5 0L0 5" stroke="#8a8a8a" stroke-width=".9"/></pattern>"""
# A line is interrupted between points that are farther apart in time than this many median steps.
_GAP_STEPS: Final = 6.0


@dataclass(frozen=True, slots=True)
class Axis:
    """Linear or logarithmic mapping of values to pixels."""

    low: float
    high: float
    start_px: float
    end_px: float
    log: bool = False

    def px(self, value: float) -> float:
        """Return the position of a value; the nearer end for one that is outside."""
        low, high, at = (_scaled(v, self.log) for v in (self.low, self.high, value))
        share = min(1.0, max(0.0, (at - low) / (high - low)))
        return self.start_px + share * (self.end_px - self.start_px)

    def ticks(self, most: int) -> list[float]:
        """Return round values within the axis, at most the given number."""
        if self.log:
            return _decades(self.low, self.high)
        step = round_step((self.high - self.low) / most)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def axis_for(values: Sequence[float], px: tuple[float, float], *, log: bool, zero: bool) -> Axis:
    """Return an axis from px[0] to px[1] that holds all values and a margin; zero: it holds 0 as well."""
    if log:
        first, last = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
        return Axis(10.0**first, 10.0 ** max(last, first + 1), *px, log=True)
    low, high = min([*values, 0.0] if zero else values), max([*values, 0.0] if zero else values)
    room = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return Axis(low if zero and low == 0 else low - room, high if zero and high == 0 < -low else high + room, *px)


def round_step(least: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is not less."""
    decade = 10.0 ** math.floor(math.log10(least))
    return float(next(digit * decade for digit in (1, 2, 5, 10) if digit * decade >= least * (1 - 1e-9)))


def coord(value: float) -> str:
    """Return a coordinate in px with one decimal."""
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text


def label(value: float) -> str:
    """Return the text of a value at a tick."""
    return f"{value + 0.0:.6g}" if abs(value) < 1e5 or value == 0 else f"{value:.0e}"


def path_d(points: Iterable[Point]) -> str:
    """Return the data of a path through points [px]."""
    return "M" + "L".join(f"{coord(x)} {coord(y)}" for x, y in points)


def polyline(points: Sequence[Point], style: str) -> str:
    """Return a line through points [px]; a single point becomes a dot."""
    if len(points) == 1:
        ((x, y),) = points
        return f"<path {style} d='M{coord(x - 1.3)} {coord(y)}h2.6'/>"
    return f"<path {style} d='{path_d(points)}'/>" if points else ""


def pieces(points: Sequence[Point]) -> Iterator[Sequence[Point]]:
    """Yield the points [s, value] in pieces, split where they are much further apart in time than their median."""
    steps = sorted(b[0] - a[0] for a, b in pairwise(points))
    limit_s = _GAP_STEPS * steps[len(steps) // 2] if len(steps) > 2 and steps[len(steps) // 2] > 0 else math.inf
    start = 0
    for k in range(1, len(points)):
        if points[k][0] - points[k - 1][0] > limit_s:
            yield points[start:k]
            start = k
    if points:
        yield points[start:]


def text(at: Point, words: str, more: str = "") -> str:
    """Return a text at a point [px]; more: attributes."""
    return f"<text x='{coord(at[0])}' y='{coord(at[1])}' {more}>{escape(words)}</text>"


def rectangles(spans: Iterable[Point], rows: Point) -> str:
    """Return the data of a path of rectangles from x to x, all between two rows [px]."""
    top, height = coord(rows[0]), coord(rows[1] - rows[0])
    return "".join(f"M{coord(a)} {top}H{coord(max(b, a + 0.6))}v{height}H{coord(a)}z" for a, b in spans)


def pixel_image(png: bytes, corner: Point, size: Point) -> str:
    """Return an embedded image whose pixels stay sharp: upper left corner, width and height [px of the page]."""
    return (
        f"<image x='{coord(corner[0])}' y='{coord(corner[1])}' width='{coord(size[0])}' height='{coord(size[1])}' "
        f"preserveAspectRatio='none' style='image-rendering:pixelated' "
        f"href='data:image/png;base64,{base64.b64encode(png).decode()}'/>"
    )


def hidden(definitions: str) -> str:
    """Return an invisible element with definitions that figures refer to."""
    return f"<svg style='position:absolute;width:0;height:0' aria-hidden='true'><defs>{definitions}</defs></svg>"


def key(style: str, name: str) -> str:
    """Return a legend entry: a sample of a line and its name."""
    return mark_key(f"<path {style} d='M1 6H33'/>", name)


def area_key(style: str, name: str) -> str:
    """Return a legend entry: a sample of a filled area and its name."""
    return mark_key(f"<rect {style} x='1' y='1' width='32' height='10'/>", name)


def mark_key(drawn: str, name: str) -> str:
    """Return a legend entry: a drawing of 34 x 12 px and its name."""
    return f"<span class='key'><svg viewBox='0 0 34 12' aria-hidden='true'>{drawn}</svg>{escape(name)}</span>"


def _scaled(value: float, log: bool) -> float:
    return math.log10(max(value, 1e-300)) if log else value


def _decades(low: float, high: float) -> list[float]:
    first, last = round(math.log10(low)), round(math.log10(high))
    step = max(1, (last - first) // 5)
    return [10.0**k for k in range(first, last + 1, step)]
