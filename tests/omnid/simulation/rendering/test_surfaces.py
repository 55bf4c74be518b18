"""Flat textured rectangles: their corners, normals, light and posters."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.simulation.rendering.surfaces import AMBIENT, DIFFUSE, POSTER_GAP_M, Rectangle, Scene

TEXTURE = np.zeros((4, 4), np.uint8)
WALL = Rectangle(np.array([0.0, 1.0, 2.0]), np.array([3.0, 0, 0]), np.array([0, 0, -2.0]), TEXTURE, "wall")


def test_corners_and_sides() -> None:
    assert (WALL.width_m, WALL.height_m) == (3.0, 2.0)
    assert WALL.corners.tolist() == [[0, 1, 2], [3, 1, 2], [3, 1, 0], [0, 1, 0]]
    assert WALL.points(np.array([[0.5, 0.25]])).tolist() == [[1.5, 1.0, 1.5]]


def test_light_is_the_same_on_both_sides_and_differs_with_the_direction() -> None:
    behind = Rectangle(WALL.origin + WALL.edge_u, -WALL.edge_u, WALL.edge_v, TEXTURE)
    assert np.allclose(behind.normal, -WALL.normal) and behind.brightness == pytest.approx(WALL.brightness)
    floor = Rectangle(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), TEXTURE)
    assert AMBIENT < WALL.brightness < floor.brightness < AMBIENT + DIFFUSE


def test_a_poster_hangs_before_its_wall_where_it_is_put() -> None:
    poster = WALL.poster(TEXTURE, (0.5, 0.25, 1.0, 0.75), "poster")
    assert (poster.width_m, poster.height_m, poster.name) == (1.0, 0.75, "poster")
    assert np.allclose(poster.origin, np.array([0.5, 1.0, 1.75]) - POSTER_GAP_M * WALL.normal)
    assert np.allclose(poster.normal, WALL.normal)


def test_rectangles_are_found_by_their_names() -> None:
    assert Scene((WALL, WALL.poster(TEXTURE, (0, 0, 1, 1), "b"))).named("b").name == "b"
