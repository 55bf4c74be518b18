"""The figures of the report; curves differ in shade, dash and marker, so that they can be printed without colour."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.models.camera import Array
from omnid.simulation.rendering.surfaces import Rectangle
from tests.simulation.recipes import SimulatedRun

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 110
STYLES = (("0.65", ":"), ("0.5", "--"), ("0.0", "-"))
LOOK = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "omnid"}


def _figure(width: float, height: float) -> Figure:
    """Return an empty figure [inches]; matplotlib is loaded here, as most tests that load this module draw nothing."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    mpl.rcParams.update(LOOK)
    return Figure(figsize=(width, height), layout="constrained")


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=DPI, bbox_inches="tight", metadata={"Software": None})


def wall(clouds: dict[str, Array], wall_m: float, path: Path) -> None:
    """Draw the points (N, 3) of each method from above and from the front, side by side (fig. 8)."""
    figure = _figure(4 * len(clouds), 5.6)
    axes = figure.subplots(2, len(clouds), sharex="row", sharey="row", height_ratios=[1.5, 1])
    for (name, points), (above, front) in zip(clouds.items(), axes.T, strict=True):
        above.scatter(points[:, 1], points[:, 0], s=0.15, c="0.0", linewidths=0)
        above.axhline(wall_m, color="0.6", lw=0.6, zorder=0)
        above.plot(0, 0, "k^")
        above.set(title=name, xlim=(2.2, -2.2), ylim=(-0.2, 4.2), aspect="equal")
        off = np.abs(points[:, 0] - wall_m) > 0.05
        front.scatter(points[~off, 1], points[~off, 2], s=0.15, c="0.6", linewidths=0)
        front.scatter(points[off, 1], points[off, 2], s=0.6, c="0.0", linewidths=0)
        front.set(xlim=(2.2, -2.2), ylim=(-0.1, 2.7), aspect="equal", xlabel="left, m")
    axes[0, 0].set_ylabel("from above: ahead, m")
    axes[1, 0].set_ylabel("from the front: height, m\n(black: over 5 cm off the wall)")
    _save(figure, path)


def turns(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the right features over the angle of the turn, median of all seeds (fig. 7, at every angle, both ways)."""
    figure = _figure(7, 3)
    axes = figure.subplots()
    for name, (shade, dash) in zip(rows[0]["found"], STYLES, strict=True):
        right = [[row["found"][name]["right"] for row in rows if row["turn_deg"] == a] for a in _angles(rows)]
        axes.plot(_angles(rows), [np.median(r) for r in right], dash, color=shade, marker=".", label=name)
    axes.set(
        xlabel="turn between two images, degrees; to the left is positive",
        ylabel="features tracked correctly",
        xticks=range(-180, 181, 36),
    )
    axes.legend(frameon=False)
    _save(figure, path)


def _angles(rows: list[dict[str, Any]]) -> list[float]:
    return sorted({row["turn_deg"] for row in rows})


def paths(estimates: dict[str, list[list[float]]], truth: list[list[float]], path: Path) -> None:
    """Draw paths over the true one, and the distance of each from it at every pair (fig. 9)."""
    figure = _figure(8, 5.4)
    above, error = figure.subplots(2, 1, height_ratios=[1, 1.2])
    true_xy = np.array(truth)
    above.plot(*true_xy.T, color="0.75", lw=5, label="truth", solid_capstyle="round")
    for (name, xy), (shade, dash) in zip(estimates.items(), STYLES, strict=True):
        above.plot(*np.array(xy).T, dash, color=shade, lw=1.2, label=name)
        error.plot(1e3 * np.linalg.norm(np.array(xy) - true_xy[: len(xy)], axis=1), dash, color=shade, label=name)
    above.set(aspect="equal", xlabel="m", ylabel="m")
    error.set(yscale="log", ylim=(0.03, 300), xlabel="pair", ylabel="position error, mm")
    figure.legend(*above.get_legend_handles_labels(), frameon=False, ncols=2, loc="outside upper center")
    _save(figure, path)


def floor_plan(run: SimulatedRun, points: Array, path_xy: dict[str, Array], path: Path) -> None:
    """Draw the map's points (N, 3) in the world, black, and paths (N, 2) over the true floor plan, grey (fig. 10)."""
    figure = _figure(9, 6.8)
    axes = figure.subplots()
    standing = points[(points[:, 2] > 0.1) & (points[:, 2] < 2.2)]
    for r in filter(_is_upright, run.scene.rectangles):
        axes.plot(*r.corners[:2, :2].T, color="0.8", lw=5 if r.name != "box" else 3, zorder=0)
    axes.scatter(standing[:, 0], standing[:, 1], s=0.5, c="black", linewidths=0)
    for (name, xy), (shade, dash) in zip(path_xy.items(), (("0.8", "-"), ("0.0", "--")), strict=True):
        axes.plot(*xy.T, dash, color=shade, lw=5 if dash == "-" else 1.2, label=name)
    axes.plot(*path_xy["truth"][0], "ko", ms=5)
    axes.set(aspect="equal", xlabel="m", ylabel="m")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.06), ncols=2, frameon=False)
    _save(figure, path)


def _is_upright(r: Rectangle) -> bool:
    return abs(r.normal[2]) < 0.1 and not r.name.startswith("poster")
