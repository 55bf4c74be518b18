"""The page of an acceptance drive: one self-contained HTML file that can be sent."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.formats.plan_view import drawn_heights
from omnid.formats.tum import Trajectory
from omnid.recordings.acceptance import PLACING_M, Acceptance
from omnid.report import plan, svg
from omnid.report.chart import Clock
from omnid.report.downsampling import Corner
from omnid.report.page import note, page, table
from omnid.version import __version__

_MOST_CORNERS: Final = 3000  # Most vertices of the path in the figure.
HEAD: Final = ("round", "A to B", "B to A", "error of lengths", "way", "end beside start", "heading at the end")


def acceptance_html(
    title: str,
    drives: Mapping[str, Acceptance],
    faults: Sequence[str],
    path: Trajectory,
    map_xyz: NDArray[np.float32],
    rig_height_m: float,
) -> str:
    """Return the page.

    drives: by the name of their poses, the judged one first. path: T_odom_base. map_xyz (M, 3) [m]: may be empty.
    rig_height_m: of the rig at the start, in the frame of the path; the base may be far below it.
    """
    first = next(iter(drives.values()))
    outcome = "Not accepted" if faults else "Accepted"
    parts = [
        f"<h1>Acceptance drive: {outcome}</h1>",
        f"<p>{escape(title)}. Marks {first.distance_m:g} m apart, {len(first.rounds)} rounds.</p>",
        *(f"<p class='warn'>{escape(line)}</p>" for line in faults),
        *(part for name, found in drives.items() for part in _drive(name, found)),
        note(
            f"A robot that is placed by eye stands some millimetres beside a mark: {1e3 * PLACING_M:g} mm are allowed "
            "for the two placings of a length or a return."
        ),
        _figure(path, map_xyz, rig_height_m),
        f"<p><small>Made by omnid {__version__}.</small></p>",
    ]
    return page("Acceptance drive", parts, svg.STYLE + plan.STYLE)


def acceptance_text(name: str, found: Acceptance) -> str:
    """Return the lines of a terminal."""
    rows = [(f"round {cells[0]}", ", ".join(cells[1:])) for cells in _rows(found)]
    rows += _sums(found)
    return "\n".join([f"{name}, marks {found.distance_m:g} m apart", *(f"  {head:<22} {text}" for head, text in rows)])


def _drive(name: str, found: Acceptance) -> list[str]:
    sums = "".join(f"<li>{escape(head)}: <b>{escape(text)}</b></li>" for head, text in _sums(found))
    return [
        f"<h2>By the {escape(name)}</h2><ul>{sums}</ul>",
        table(HEAD, [tuple(map(escape, r)) for r in _rows(found)]),
    ]


def _sums(found: Acceptance) -> list[tuple[str, str]]:
    ends_m = [one.end_error_m for one in found.rounds]
    worst = max(one.end_error_m / max(one.way_m, 1e-9) for one in found.rounds)
    rows = [
        ("length error", f"{100 * found.length_error_ratio:+.2f} % (spread {100 * found.length_spread_ratio:.2f} %)"),
        ("end error", f"{1e3 * max(ends_m):.0f} mm at most, {100 * worst:.2f} % of the way"),
    ]
    if math.isfinite(found.repeatability_m):
        rows.append(("repeatability", f"{1e3 * found.repeatability_m:.0f} mm over {len(found.rounds)} rounds"))
    return rows


def _rows(found: Acceptance) -> list[tuple[str, ...]]:
    return [
        (
            str(number),
            f"{one.there_m:.3f} m",
            f"{one.back_m:.3f} m",
            f"{100 * one.length_error_ratio:+.2f} %",
            f"{one.way_m:.2f} m",
            f"{1e3 * one.end_error_m:.0f} mm",
            f"{math.degrees(one.end_heading_rad):+.2f} deg" if math.isfinite(one.end_heading_rad) else "turned round",
        )
        for number, one in enumerate(found.rounds, 1)
    ]


def _figure(path: Trajectory, map_xyz: NDArray[np.float32], rig_height_m: float) -> str:
    step = max(1, len(path.T) // _MOST_CORNERS)
    seconds = (path.stamps_ns - path.stamps_ns[0]) * 1e-9
    corners = [
        Corner(float(T[0, 3]), float(T[1, 3]), float(t_s), -1)
        for T, t_s in zip(path.T[::step], seconds[::step], strict=True)
    ]
    confidence = np.ones(len(map_xyz), np.float32)
    above_base_m = rig_height_m - float(path.T[0, 2, 3])
    drawn = plan.Plan(corners, map_xyz, confidence, rig_height_m, drawn_heights(above_base_m))
    return plan.plan_figure(drawn, Clock(0.0, max(float(seconds[-1]), 1e-2)))
