"""Page about a map of places: its grid, keyframes and loops, and the paths before and after the loops were closed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.png import png
from omnid.core.mapping.occupancy_grid import FREE, OCCUPIED, Grid, known_part
from omnid.core.places.place_map import PlaceMap
from omnid.core.places.place_rig import PlaceRig
from omnid.core.places.place_views import MappedDrive, drives, grid
from omnid.report.page import facts, page, table
from omnid.report.svg import STYLE as SVG_STYLE
from omnid.report.svg import Point, coord, key, pixel_image, polyline

Array = NDArray[np.float64]

CELL_M: Final = 0.05
MAX_SIDE_PX: Final = 1000.0
MARGIN_M: Final = 0.3
FREE_GREY, UNKNOWN_GREY, OCCUPIED_GREY = 255, 225, 90  # Grey levels of cells.
STYLE: Final = """.after{fill:none;stroke:#111;stroke-width:1.7}
.before{fill:none;stroke:#b33;stroke-width:1.4;stroke-dasharray:5 3}.loop{stroke:#06c;stroke-width:1;stroke-opacity:.6}
.keyframe{fill:#111}.key{margin-left:.9em}.key svg{display:inline-block;width:34px;height:12px;margin-right:.3em}"""


def map_page(title: str, lines: Sequence[tuple[str, str]], places: PlaceMap, rig: PlaceRig) -> str:
    """Return the page; lines: names and values of the facts at its head."""
    driven = drives(places, rig)
    rows = [(escape(name), escape(value)) for name, value in lines]
    parts = [
        f"<h1>{escape(title)}</h1>",
        facts(rows),
        "<h2>Keyframes and loops</h2>",
        _figure(places, rig, driven),
        "<h2>Corrections by the loops</h2>",
        _corrections(places, driven),
    ]
    return page(title, parts, SVG_STYLE + STYLE)


def _figure(places: PlaceMap, rig: PlaceRig, driven: Sequence[MappedDrive]) -> str:
    """Return the plan; x (forward at the start of the map) to the right, y up."""
    cells = known_part(grid(places, rig, CELL_M))
    rows, columns = cells.cells.shape
    (left, bottom), top = cells.corner, cells.corner[1] + rows * cells.cell_m
    paths = np.concatenate(
        [
            np.array([[left, bottom], [left + columns * cells.cell_m, top]]),
            *(T[:, :2, 3] for drive in driven for T in (drive.T_map_base, drive.T_by_odometry)),
        ]
    )
    low, high = paths.min(axis=0) - MARGIN_M, paths.max(axis=0) + MARGIN_M
    px_per_m = MAX_SIDE_PX / float((high - low).max())

    def px(xy: Array) -> Point:
        return float((xy[0] - low[0]) * px_per_m), float((high[1] - xy[1]) * px_per_m)

    at = {id: px(T[:2, 3]) for drive in driven for id, T in zip(drive.ids, drive.T_map_base, strict=True)}
    parts = [
        _image(cells, px(np.array([left, top])), px_per_m),
        *_loops(places, at),
        *(polyline([px(T[:2, 3]) for T in drive.T_by_odometry], "class='before'") for drive in driven),
        *(polyline([px(T[:2, 3]) for T in drive.T_map_base], "class='after'") for drive in driven),
        *_keyframes(places, at),
        f"<rect x='10' y='20' width='{coord(px_per_m)}' height='4'/><text x='10' y='15'>1 m</text>",
    ]
    box = f"0 0 {coord(float(high[0] - low[0]) * px_per_m)} {coord(float(high[1] - low[1]) * px_per_m)}"
    keys = "".join(
        (
            key("class='after'", "the path in the map"),
            key("class='before'", "by odometry alone"),
            key("class='loop'", "a place that was recognised"),
        )
    )
    return (
        f"<figure class='sheet'><figcaption>{keys}</figcaption><svg viewBox='{box}' role='img' aria-label='Map of "
        f"places'>{''.join(parts)}</svg><small>Dots: keyframes. Behind them what their range scans saw: free floor has "
        "the shade of the page, what is occupied stands out, what lies between is unknown.</small></figure>"
    )


def _image(cells: Grid, corner: Point, px_per_m: float) -> str:
    """Return the grid, whose upper left corner [px] is given."""
    greys = np.where(cells.cells == FREE, FREE_GREY, UNKNOWN_GREY).astype(np.uint8)
    greys[cells.cells == OCCUPIED] = OCCUPIED_GREY
    rows, columns = greys.shape
    size = columns * cells.cell_m * px_per_m, rows * cells.cell_m * px_per_m
    return pixel_image(png(greys[::-1]), corner, size)


def _loops(places: PlaceMap, at: Mapping[int, Point]) -> Iterator[str]:
    for link in places.links:
        if link.is_loop:
            (x1, y1), (x2, y2) = at[link.a], at[link.b]
            yield (
                f"<path class='loop' d='M{coord(x1)} {coord(y1)}L{coord(x2)} {coord(y2)}'>"
                f"<title>{link.a} to {link.b}: {link.inliers} features</title></path>"
            )


def _keyframes(places: PlaceMap, at: Mapping[int, Point]) -> Iterator[str]:
    for id, (x, y) in at.items():
        keyframe = places.keyframes[id]
        yield (
            f"<circle class='keyframe' cx='{coord(x)}' cy='{coord(y)}' r='2.5'><title>keyframe {id}, session "
            f"{keyframe.session}, {keyframe.features.count} features</title></circle>"
        )


def _corrections(places: PlaceMap, driven: Sequence[MappedDrive]) -> str:
    """Return a table of the drives: how far the loops moved their keyframes."""
    rows = []
    for drive in driven:
        moved_m = np.linalg.norm((drive.T_map_base - drive.T_by_odometry)[:, :3, 3], axis=1)
        own = set(drive.ids)
        loops = sum(link.is_loop and (link.a in own or link.b in own) for link in places.links)
        path_m = np.linalg.norm(np.diff(drive.T_map_base[:, :3, 3], axis=0), axis=1).sum()
        rows.append(
            (
                f"session {drive.session}, keyframes {drive.ids[0]} to {drive.ids[-1]}",
                str(len(drive.ids)),
                f"{path_m:.1f} m",
                str(loops),
                f"{1e3 * moved_m.max():.0f} mm",
                f"{1e3 * moved_m[-1]:.0f} mm",
            )
        )
    return table(("drive", "keyframes", "path", "loops", "largest correction", "at its end"), rows)
