"""A path of any length in bounded memory: the spacing of its vertices doubles whenever there are too many."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


class ThinnedPath:
    """Vertices at least a step apart; when there are too many, every second one is dropped and the step doubles.

    Dropping every second vertex always halves their number, also where the robot turns at one place.
    """

    def __init__(self, most: int, step_m: float) -> None:
        """most: largest number of vertices, at least 2. step_m: spacing at first."""
        self._most, self._step_m = most, step_m
        self.vertices: list[tuple[float, float]] = []  # x, y, m
        self._pending: tuple[float, float] | None = None  # the newest one, while it is less than a step away

    def add(self, x_m: float, y_m: float) -> None:
        """Add the next vertex; it waits while it is less than a step away from the last one."""
        vertex, self._pending = (x_m, y_m), None
        if self.vertices and math.dist(self.vertices[-1], vertex) < self._step_m:
            self._pending = vertex
            return
        self.vertices.append(vertex)
        if len(self.vertices) > self._most:
            # A dropped last one waits for the next vertex.
            self._pending = self.vertices[-1] if len(self.vertices) % 2 == 0 else None
            self.vertices, self._step_m = self.vertices[::2], 2 * self._step_m

    def xy(self) -> NDArray[np.float64]:
        """Return the positions (N, 2) [m] of the vertices and of the end of the path."""
        end = [] if self._pending is None else [self._pending]
        return np.array([*self.vertices, *end], float).reshape(-1, 2)
