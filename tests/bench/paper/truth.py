"""Ground truth of a scene: rays cast into it, visibility, and distances of points from its surfaces; all exact."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array
from omnid.simulation.rendering.surfaces import Rectangle, Scene

Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]
TOUCHING_M = 1e-6


def cast(scene: Scene, origin: Array, rays: Array) -> tuple[Array, Indices]:
    """Return the distances (N,) and rectangles (N,) that rays (N, 3) from a point (3,) hit first.

    Distances are in units of each ray; inf and -1 where nothing is hit.
    """
    nearest, which = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for number, rectangle in enumerate(scene.rectangles):
        distance = _intersect(rectangle, origin, rays)
        nearer = distance < nearest
        nearest[nearer], which[nearer] = distance[nearer], number
    return nearest, which


def _intersect(r: Rectangle, origin: Array, rays: Array) -> Array:
    """Return the distance (N,) along the rays to one rectangle, inf where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((r.origin - origin) @ r.normal) / (rays @ r.normal)
        uv = _fractions(r, origin + distance[:, None] * rays)
        hit = (distance > TOUCHING_M) & ((uv >= 0) & (uv <= 1)).all(axis=1)
    return np.where(hit, distance, np.inf)


def _fractions(r: Rectangle, points: Array) -> Array:
    """Return the positions (N, 2) of points (N, 3) along both edges, as fractions of the edges."""
    along = points - r.origin
    return np.column_stack([along @ r.edge_u / r.width_m**2, along @ r.edge_v / r.height_m**2])


def sees(scene: Scene, origin: Array, points: Array, slack_m: float = 0.02) -> Flags:
    """Return which points (N, 3) are visible from a viewpoint (3,)."""
    rays = points - origin
    distance, _ = cast(scene, origin, rays)
    return np.asarray((distance - 1) * np.linalg.norm(rays, axis=1) > -slack_m)


def surface_distance_m(scene: Scene, points: Array) -> Array:
    """Return the distance (N,) of points (N, 3) from the nearest surface."""
    nearest = np.full(len(points), np.inf)
    for r in scene.rectangles:
        uv = np.clip(_fractions(r, points), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(points - r.points(uv), axis=1))
    return nearest
