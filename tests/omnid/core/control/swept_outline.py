"""A second account of contacts for the tests of the collision monitor: a rectangle swept along its arc in small steps.

It shares no code with omnid: poses are summed up step by step, points are turned by complex numbers. Outlines are
(front, rear, half width) in m, motions (m/s, rad/s).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Box = tuple[float, float, float]
STEP_M = 1e-3  # of the fastest point of interest


def depth_m(box: Box, points: Complex | complex) -> Array:
    """Return the distance of points from the outline, below 0 inside."""
    front_m, rear_m, half_width_m = box
    points = np.asarray(points)
    dx = np.maximum(points.real - front_m, -rear_m - points.real)
    dy = np.abs(points.imag) - half_width_m
    outside = np.hypot(np.maximum(dx, 0.0), np.maximum(dy, 0.0))
    return np.where(outside > 0.0, outside, np.maximum(dx, dy))


def sweep(
    motion: tuple[float, float], points: Sequence[complex], longest_s: float, step_s: float = 0.0
) -> tuple[Array, Complex]:
    """Return times [s] and, for each of them, points that stand in the axes of the base, (times, points)."""
    v, w = motion
    fastest_mps = abs(v) + abs(w) * (max(abs(point) for point in points) + abs(v) * longest_s)
    step_s = step_s or max(STEP_M / fastest_mps, longest_s / 100_000)
    times = np.arange(0.0, longest_s, step_s)
    yaws = w * times
    # Midpoint rule: the error is of the order of the cube of a step.
    steps = v * step_s * np.exp(1j * (yaws + w * step_s / 2))
    places = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
    return times, (np.asarray(points)[None, :] - places[:, None]) * np.exp(-1j * yaws)[:, None]


def contact_s(box: Box, motion: tuple[float, float], points: Sequence[complex], longest_s: float) -> float:
    """Return when the outline first contains a point; inf if it does not within the time."""
    times, seen = sweep(motion, points, longest_s)
    hits = np.flatnonzero((depth_m(box, seen) <= 0.0).any(axis=1))
    return float(times[hits[0]]) if len(hits) else math.inf


def approach_mps(box: Box, motion: tuple[float, float], point: complex) -> float:
    """Return the speed with which the outline nears a point, or takes it deeper inside; below 0 where it leaves it."""
    step_s = 1e-6
    seen = sweep(motion, [point], 1.5 * step_s, step_s)[1][:, 0]
    before, after = depth_m(box, seen)
    return float(before - after) / step_s


def grown(box: Box, by_m: float) -> Box:
    """Return the outline with all sides farther out."""
    return box[0] + by_m, box[1] + by_m, box[2] + by_m
