"""Walls, posters and boxes of a world."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from omnid.simulation.rendering.shapes import CEILING_M, PX_PER_M, box, painted, posters
from omnid.simulation.rendering.textures import PAINTERS
from tests.simulation.builders import wall


def test_a_wall_stands_between_its_points_and_faces_inwards() -> None:
    found = wall(np.random.default_rng(1), next(iter(PAINTERS)), (0, 2), (3, 2))
    assert found.width_m == 3.0 and found.height_m == CEILING_M and found.corners[2].tolist() == [3, 2, 0]
    assert found.texture.shape == (round(CEILING_M * PX_PER_M), round(3 * PX_PER_M))
    assert np.allclose(found.normal, (0, 1, 0)), "away from inside"


def test_posters_hang_on_their_wall_and_do_not_overlap() -> None:
    rng = np.random.default_rng(2)
    on = wall(rng, next(iter(PAINTERS)), (0, 0), (4, 0))
    hung = posters(rng, on, 12, first=3)  # a third of a metre each: less than the largest poster
    spans = sorted((float(one.corners[:, 0].min()), float(one.corners[:, 0].max())) for one in hung)
    assert [one.name for one in hung] == [f"poster{number}" for number in range(3, 15)]
    assert spans[0][0] >= 0 and spans[-1][1] <= 4 and all(a[1] <= b[0] for a, b in pairwise(spans))


def test_a_box_has_its_size_on_the_floor_and_looks_outwards() -> None:
    faces = box(np.random.default_rng(3), (1.0, 2.0), (0.6, 0.4, 0.5), np.deg2rad(30))
    corners = np.vstack([face.corners for face in faces])
    middle = corners.mean(axis=0)
    assert len(faces) == 5 and np.isclose(corners[:, 2].min(), 0) and np.isclose(corners[:, 2].max(), 0.5)
    assert np.allclose(middle[:2], (1.0, 2.0))
    sides = sorted(round(face.width_m, 6) for face in faces[:4])
    assert sides == [0.4, 0.4, 0.6, 0.6]
    assert all((face.corners.mean(axis=0) - middle) @ face.normal < 0 for face in faces[:4])


def test_a_small_surface_has_a_texture_too() -> None:
    assert min(painted(np.random.default_rng(4), next(iter(PAINTERS)), (0.001, 0.001)).shape[:2]) >= 8
