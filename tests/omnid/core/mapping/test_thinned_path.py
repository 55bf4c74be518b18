"""A path in bounded memory: spacing, ends, and what vertices take over from dropped ones."""

from __future__ import annotations

import math
from itertools import pairwise

from omnid.core.mapping.thinned_path import ThinnedPath

Vertex = tuple[float, float, int]  # x, y [m], severity


def is_step(last: Vertex, new: Vertex, step_m: float) -> bool:
    return math.dist(last[:2], new[:2]) >= step_m


def with_worse(dropped: Vertex, new: Vertex) -> Vertex:
    return new[0], new[1], max(dropped[2], new[2])


def test_a_long_path_keeps_its_ends_and_an_even_spacing() -> None:
    path = ThinnedPath(100, 0.5, is_step)
    for k in range(10_000):
        path.add((float(k), 0.0, 0))
    x = [vertex[0] for vertex in path.with_end()]
    assert 50 <= len(x) <= 101 and x[0] == 0 and x[-1] == 9999
    assert path.step_m == 0.5 * 2**path.thinned
    assert max(b - a for a, b in pairwise(x)) <= 2 * path.step_m


def test_a_robot_at_rest_adds_nothing() -> None:
    path = ThinnedPath(100, 0.01, is_step)
    kept = [path.add((0.001 * (k % 2), 0.0, k % 3)) for k in range(50_000)]
    assert sum(kept) == 1 and len(path.vertices) == 1 and len(path.with_end()) == 2


def test_a_dropped_vertex_hands_its_severity_on() -> None:
    for worst in range(1, 4000, 37):
        path = ThinnedPath(64, 0.5, is_step, with_worse)
        for k in range(4000):
            path.add((float(k), 0.0, 2 if k == worst else 0))
        severe = [vertex for vertex in path.with_end() if vertex[2] == 2]
        assert len(severe) == 1 and 0 <= severe[0][0] - worst <= 2 * path.step_m


def test_vertices_that_are_all_steps_are_bounded_too() -> None:
    path = ThinnedPath(100, 0.5, lambda *_: True)
    for k in range(1001):
        path.add((0.0, 0.0, k))
    assert len(path.vertices) <= 100 and path.with_end()[-1][2] == 1000


def test_clear_begins_again() -> None:
    path = ThinnedPath(10, 0.5, is_step)
    for k in range(50):
        path.add((float(k), 0.0, 0))
    path.clear()
    assert (path.vertices, path.with_end(), path.step_m, path.thinned) == ([], [], 0.5, 0)
