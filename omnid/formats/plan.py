"""Plan: a map from above with paths over it, x (forward) to the right, y (left) up; readable in black and white."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib.rig import MIN_HEIGHT_M
from omnid.core.mapping.voxel_map import MapPoints
from omnid.formats.tum import POSITION_LIMIT_M

if TYPE_CHECKING:  # it takes a second and 30 MB, also of runs that draw no plan
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PX_PER_INCH = 100
MARGIN_PX = 64  # for the ticks and the names of the axes
SIDE_PX = 1400  # of an image, at most
MAX_PX_PER_M = 100.0  # of a small map
CHUNK = 1000  # points of a line that are drawn at once: agg refuses long ones that turn everywhere, as of a wrong pose
_CELL_M = 0.05  # default voxel: at a finer scale cells are drawn as squares, not as scattered dots


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines of one style."""

    parts: Sequence[Array]  # each (N, 2) m
    colour: str
    width_pt: float


def drawn_heights(height_m: float) -> tuple[float, float]:
    """Return the lowest and the highest z [m] relative to the lower viewpoint that a plan shows: those above the floor.

    height_m: of the viewpoint above the floor; less than MIN_HEIGHT_M, as 0, where the rig does not state it.
    Lower surfaces are the floor: obstacles begin at 0.06 m (obstacles.scan.heights_m), and a voxel has 0.05 m.
    """
    return max(-1.0, 0.1 - height_m if height_m >= MIN_HEIGHT_M else -1.0), 1.5


def plan_view(
    points: MapPoints,
    trajectory_xy: Array,
    *,
    heights_m: tuple[float, float],
    loops_xy: Iterable[Array] = (),
) -> Image:
    """Return a BGR image (H, W, 3) of the map's points between two heights [m], and the path (N, 2) [m] over it.

    A row of the path that is NaN, or too far away to be drawn, is a gap: what is before and after it is not joined.
    Heights are z of the points' frame. loops_xy: (L, 2, 2) [m] ends of lines between places of the path that were
    recognised as one.
    """
    drawable = _drawable(trajectory_xy)
    path = trajectory_xy[drawable].astype(np.float64)
    gaps = np.flatnonzero(np.diff(np.flatnonzero(drawable)) > 1) + 1
    pieces = np.split(path, gaps)
    lines = [Lines(pieces, "white", 5), Lines(pieces, "#be0000", 2), Lines(list(loops_xy), "#0064c8", 1)]
    return image_of(draw_plan(*between(points.xyz, points.confidence, heights_m), lines, path))


def between(
    xyz: NDArray[np.floating], confidence: NDArray[np.float32], heights_m: tuple[float, float]
) -> tuple[Array, NDArray[np.float32]]:
    """Return x, y (N, 2) and confidence of the points (M, 3) that can be drawn, between two heights [m]."""
    inside = _drawable(xyz) & (xyz[:, 2] >= heights_m[0]) & (xyz[:, 2] <= heights_m[1])
    return xyz[inside, :2].astype(np.float64), confidence[inside]


def _drawable(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return flags of the rows that are finite and near enough to be drawn."""
    return np.asarray((np.abs(points) <= POSITION_LIMIT_M).all(axis=1))


def draw_plan(xy_m: Array, confidence: NDArray[np.float32], lines: Sequence[Lines], path: Array) -> Axes:
    """Return axes in m with points (N, 2), lines over them, and the start and the end of a path (M, 2).

    A cell is the darker, the more confident points it has. The farthest half per cent of the points on each side may be
    cut off, because a few false far ones must not shrink the rest; lines never are. Neither side exceeds SIDE_PX.
    """
    from matplotlib.figure import Figure

    # 1. The area: that of the lines and of most points, at least 2 m, and not so narrow that a straight path vanishes.
    bulk = np.quantile(xy_m, (0.005, 0.995), axis=0) if len(xy_m) else np.empty((0, 2))
    corners = np.vstack([bulk, path, *(part for one in lines for part in one.parts)])
    corners = corners if len(corners) else np.zeros((1, 2))
    low_m, high_m = corners.min(axis=0), corners.max(axis=0)
    half_m = np.maximum(1.06 / 2 * (high_m - low_m), 1.0)
    half_m = np.maximum(half_m, 0.1 * half_m.max())
    low_m, high_m = (low_m + high_m) / 2 - half_m, (low_m + high_m) / 2 + half_m
    px_per_m = min((SIDE_PX - 2 * MARGIN_PX) / (2 * float(half_m.max())), MAX_PX_PER_M)
    size_px = np.floor(2 * half_m * px_per_m) + 2 * MARGIN_PX
    figure = Figure(figsize=tuple((size_px / PX_PER_INCH).tolist()), dpi=PX_PER_INCH)
    axes = figure.add_axes((*(MARGIN_PX / size_px), *(1 - 2 * MARGIN_PX / size_px)))
    # 2. The points by cells, which are never finer than a voxel: that would leave white lines in a wall.
    cell_m = np.ceil(px_per_m * _CELL_M) / px_per_m
    edges = [low + cell_m * np.arange(2 + (high - low) // cell_m) for low, high in zip(low_m, high_m, strict=True)]
    density = np.histogram2d(xy_m[:, 0], xy_m[:, 1], edges, weights=confidence)[0].T
    median = float(np.median(density[density > 0])) if density.any() else 1.0
    grey = np.where(density > 0, 190.0 - 190.0 * density / (density + median), 255.0)
    extent = (edges[0][0], edges[0][-1], edges[1][0], edges[1][-1])
    axes.imshow(grey, "gray", vmin=0, vmax=255, interpolation="nearest", origin="lower", extent=extent, aspect="auto")
    # 3. The lines, and both ends of the path.
    for one in lines:
        for part in one.parts:
            axes.plot(*part.T, color=one.colour, linewidth=one.width_pt)
    for point, name, inside, above_pt in ((path[-1:], "end", "black", -18), (path[:1], "start", "white", 10)):
        for place in point:
            axes.annotate(name, place, (0, above_pt), textcoords="offset points", ha="center")
        axes.plot(*point.T, "o", markersize=9, markeredgecolor="black", markerfacecolor=inside)
    axes.set(xlim=(low_m[0], high_m[0]), ylim=(low_m[1], high_m[1]), xlabel="x forward [m]", ylabel="y left [m]")
    return axes


def image_of(axes: Axes) -> Image:
    """Return the figure of axes as a BGR image (H, W, 3)."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(axes.figure.figure)
    with rc_context({"agg.path.chunksize": CHUNK}):
        canvas.draw()  # type: ignore[no-untyped-call]
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 2::-1])  # type: ignore[no-untyped-call]


def shares_of(axes: Axes, xy_m: Array) -> Array:
    """Return the places (N, 2) of points (N, 2) [m] in the image, as fractions of its width and, from above, height."""
    return np.asarray(axes.transData.transform(xy_m) / axes.figure.bbox.size * (1, -1) + (0, 1))
