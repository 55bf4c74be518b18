"""Elements of a self-contained HTML page: head, tables, embedded images, and charts over time.

Charts are drawn by uPlot: one time, one zoom and one cursor for all.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from collections.abc import Sequence
from functools import cache
from html import escape
from importlib.resources import files
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
COLUMNS: Final = 400  # of a chart, in each of which the lowest and the highest value are kept
Image = NDArray[np.uint8]

# Control characters except tab and newline, which a terminal would obey where the page is printed.
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


class Curve(NamedTuple):
    """A line of a chart."""

    name: str
    t_s: Array  # (N,) rising
    values: Array  # (N,); NaN: unknown


def chart(title: str, curves: Sequence[Curve], unit: str = "", *, log: bool = False, note: str = "") -> str:
    """Return a figure; "" where no curve has two values. Lengths below 0.1 m are shown in mm."""
    shown = []
    for name, t_s, values in curves:
        valid = np.isfinite(values) & ((values > 0) | (not log))
        if np.count_nonzero(valid) > 1:
            shown.append(Curve(name, t_s[valid], values[valid]))
    if not shown:
        return ""
    if unit == "m" and max(np.abs(values).max() for _, _, values in shown) < 0.1:
        unit, shown = "mm", [Curve(name, t_s, 1e3 * values) for name, t_s, values in shown]
    lines = [{"name": name, "points": thinned(t_s, values)} for name, t_s, values in shown]
    data = escape(json.dumps({"lines": lines, "log": log, "unit": unit}, separators=(",", ":")))
    caption = f"<b>{escape(title)}</b>{f' [{escape(unit)}]' if unit else ''}"
    footnote = f"<small>{escape(note)}</small>" if note else ""
    return (
        f"<figure class='chart'><figcaption>{caption}</figcaption><div data-chart=\"{data}\"></div>{footnote}</figure>"
    )


def thinned(t_s: Array, values: Array) -> list[tuple[float, float | None]]:
    """Return at most two points for each column, the lowest and the highest, and None in gaps of six usual steps."""
    step = -(-len(t_s) // (2 * COLUMNS))
    if step > 1:
        starts = np.arange(0, len(t_s), 2 * step)
        middles = np.minimum(starts + step, len(t_s) - 1)
        bounds = [bound.reduceat(values, starts) for bound in (np.minimum, np.maximum)]
        t_s, values = t_s[np.column_stack([starts, middles])].ravel(), np.column_stack(bounds).ravel()
    steps_s = np.diff(t_s)
    gaps = np.flatnonzero(steps_s > 6.0 * np.median(steps_s)) + 1 if len(steps_s) > 2 else np.zeros(0, int)
    t_s, values = np.insert(t_s, gaps, (t_s[gaps - 1] + t_s[gaps]) / 2), np.insert(values, gaps, np.nan)
    rounded = zip(t_s.round(3).tolist(), values.tolist(), strict=True)
    return [(t, float(f"{value:.6g}") if math.isfinite(value) else None) for t, value in rounded]


def grid(figures: Sequence[str]) -> str:
    """Return figures side by side where there is room."""
    return f"<div class='grid2'>{''.join(figures)}</div>" if any(figures) else ""


@cache
def colours() -> dict[str, str]:
    """Return the colours of the style sheet by their names."""
    return dict(re.findall("--([a-z]+):(#[0-9a-f]{6})", (files("omnid.report") / "report.css").read_text("utf-8")))


@cache
def style_and_script() -> tuple[str, str]:
    """Return the style of a report with charts, and the script that draws them."""
    found = (files("omnid.report") / "uplot.html").read_text("utf-8").strip()
    licence, _, rest = found.partition("--><style>")
    style, _, script = rest.partition("</style><script>")
    licence = licence.removeprefix("<!--").strip()
    own_style, own = ((files("omnid.report") / name).read_text("utf-8") for name in ("report.css", "charts.js"))
    return style + own_style, f"/* {licence} */\n{script.removesuffix('</script>')}\n{own}"


def page(title: str, parts: Sequence[str], style: str = "", script: str = "") -> str:
    """Return an HTML page of parts, which are HTML; style is appended to page.css. It may run the script, and no other.

    A page shows text from logs of unknown origin: it loads nothing, and runs only the script with this digest.
    """
    own_style = (files("omnid.report") / "page.css").read_text("utf-8")
    script = _CONTROL.sub("\N{REPLACEMENT CHARACTER}", script)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = f"; script-src 'sha256-{digest}'" if script else ""
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:{allowed}"
    text = (
        f"<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><meta http-equiv='Content-Security-Policy' "
        f"content=\"{policy}\"><meta name='viewport' content='width=device-width'>"
        f"<title>{escape(title)}</title><style>{own_style}{style}</style></head>"
        f"<body>{''.join(parts)}{f'<script>{script}</script>' if script else ''}</body></html>\n"
    )
    return _CONTROL.sub("\N{REPLACEMENT CHARACTER}", text)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table; cells are HTML, those that begin with <td as they are."""
    titles = "".join(f"<th>{title}</th>" for title in head)
    lines = ["".join(cell if cell.startswith("<td") else f"<td>{cell}</td>" for cell in row) for row in rows]
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in (titles, *lines))}</table>"


def note(text: str) -> str:
    """Return a paragraph with a remark."""
    return f"<p class='note'>{escape(text)}</p>"


def embedded(image: Image, kind: str = "jpeg") -> str:
    """Return the tag of an image; kind: jpeg, or png for drawings."""
    data = cv2.imencode(f".{kind}", image)[1]
    return f"<img src='data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}' alt=''>"


def figure(image: Image, caption: str) -> str:
    """Return an embedded image with a caption."""
    return f"<figure>{embedded(image)}<figcaption>{escape(caption)}</figcaption></figure>"
