"""A path of any length in bounded memory: the spacing of its vertices doubles whenever there are too many."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Vertex(NamedTuple):
    """A position on a path."""

    x_m: float
    y_m: float
    after_gap: bool = False  # the robot was put elsewhere before it


class ThinnedPath:
    """Vertices at least a step apart; when there are too many, every second one is dropped and the step doubles.

    Dropping every second vertex always halves their number, also where the robot turns at one place. Vertices after a
    gap are always kept at first; the next one takes a gap over from a dropped one.
    """

    def __init__(self, most: int, step_m: float) -> None:
        """most: largest number of vertices, at least 2. step_m: spacing at first."""
        self._most, self._first_step_m = most, step_m
        self.clear()

    def clear(self) -> None:
        """Begin a new path."""
        self.vertices: list[Vertex] = []
        self.step_m = self._first_step_m
        self._pending: Vertex | None = None  # the newest vertex, while it is less than a step away
        self.thinned = 0  # number of times that vertices were dropped

    def add(self, vertex: Vertex) -> None:
        """Add the next vertex; it waits while it is less than a step away from the last one."""
        if self._pending is not None:
            vertex, self._pending = _after(self._pending, vertex), None
        if self.vertices and not vertex.after_gap and math.dist(self.vertices[-1][:2], vertex[:2]) < self.step_m:
            self._pending = vertex
            return
        self.vertices.append(vertex)
        if len(self.vertices) > self._most:
            vertices, self.step_m = self.vertices, 2 * self.step_m
            self.thinned += 1
            # A dropped last one waits for the next vertex.
            self.vertices = vertices[:1] + list(map(_after, vertices[1::2], vertices[2::2]))
            self._pending = vertices[-1] if len(vertices) % 2 == 0 else None

    def xy(self) -> NDArray[np.float64]:
        """Return the positions (N, 2) [m] of the vertices and of the end of the path."""
        end = [] if self._pending is None else [self._pending]
        return np.array([vertex[:2] for vertex in (*self.vertices, *end)], float).reshape(-1, 2)


def _after(dropped: Vertex, vertex: Vertex) -> Vertex:
    """Return a vertex with the gap before a dropped one."""
    return vertex._replace(after_gap=dropped.after_gap or vertex.after_gap)
