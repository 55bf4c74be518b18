"""A path of any length in bounded memory: the spacing of its vertices doubles whenever there are too many."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


def _unchanged(_: object, vertex: T) -> T:
    return vertex


class ThinnedPath(Generic[T]):
    """Vertices at least a step apart; when there are too many, every second one is dropped and the step doubles.

    Dropping every second vertex always halves their number, also where the robot turns at one place.
    """

    def __init__(
        self,
        most: int,
        step_m: float,
        is_step: Callable[[T, T, float], bool],
        inherit: Callable[[T, T], T] = _unchanged,
    ) -> None:
        """most: largest number of vertices, at least 2. step_m: spacing at first.

        is_step(last, vertex, step_m): True if a vertex is a step away from the last one that was kept.
        inherit(dropped, vertex): the next vertex with what it takes over from a dropped one, such as its worse state.
        """
        self._most, self._first_step_m = most, step_m
        self._is_step, self._inherit = is_step, inherit
        self.clear()

    def clear(self) -> None:
        """Begin a new path."""
        self.vertices: list[T] = []
        self.step_m = self._first_step_m
        self._pending: T | None = None  # the newest vertex, while it is less than a step away
        self.thinned = 0  # number of times that vertices were dropped

    def add(self, vertex: T) -> bool:
        """Add the next vertex; True if it is kept, False while it is less than a step away from the last one."""
        if self._pending is not None:
            vertex, self._pending = self._inherit(self._pending, vertex), None
        if self.vertices and not self._is_step(self.vertices[-1], vertex, self.step_m):
            self._pending = vertex
            return False
        self.vertices.append(vertex)
        if len(self.vertices) > self._most:
            self._thin()
        return True

    def with_end(self) -> list[T]:
        """Return the vertices and the end of the path."""
        return self.vertices if self._pending is None else [*self.vertices, self._pending]

    def _thin(self) -> None:
        vertices, self.step_m = self.vertices, 2 * self.step_m
        self.thinned += 1
        # Each vertex takes over from the dropped one before it; a dropped last one waits for the next vertex.
        self.vertices = vertices[:1] + [
            self._inherit(dropped, vertex) for dropped, vertex in zip(vertices[1::2], vertices[2::2], strict=False)
        ]
        self._pending = vertices[-1] if len(vertices) % 2 == 0 else None
