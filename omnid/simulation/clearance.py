"""Distance of a robot's outline, a disc, from the objects in its world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.world import Ground, World

Array = NDArray[np.float64]
FLOOR_M = 0.02  # what is lower than this is driven over


LEVEL: Final = Ground()


def footprints(rectangles: Sequence[Rectangle], height_m: float, ground: Ground = LEVEL) -> Array:
    """Return the segments (N, 2, 2) [m] on the floor of all that reaches below a height, other than the floor.

    Heights count from the ground below; rectangles named "floor" are never met. Boxes and walls are closed
    by upright rectangles, so that their outlines are enough.
    """
    segments = []
    for rectangle in rectangles:
        if rectangle.name == "floor":
            continue
        corners = rectangle.corners
        corners[:, 2] -= ground.heights_m(corners[:, 0].mean())
        if np.ptp(corners[:, 2]) > FLOOR_M and corners[:, 2].min() < height_m and corners[:, 2].max() > FLOOR_M:
            spread = corners[:, :2] - corners[0, :2]
            far = int(np.argmax((spread**2).sum(axis=1)))
            other = int(np.argmax(((corners[:, :2] - corners[far, :2]) ** 2).sum(axis=1)))
            segments.append(corners[[far, other], :2])
    return np.array(segments).reshape(-1, 2, 2)


def obstacles_of(world: World, height_m: float) -> Array:
    """Return the segments (N, 2, 2) of all that stands in a world, of its panes, and of the edges of its floor."""
    return np.concatenate([footprints((*world.standing, *world.panes), height_m, world.ground), world.edges])


def distances_m(segments: Array, places: Array) -> Array:
    """Return the distances (M,) [m] of places (M, 2) from the nearest of segments (N, 2, 2); inf without any."""
    a, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    to_place = places[:, None] - a
    share = np.clip((to_place * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12), 0.0, 1.0)
    distances = np.linalg.norm(to_place - share[..., None] * along, axis=2)
    return np.asarray(distances.min(axis=1, initial=np.inf))


def clearance_m(segments: Array, place: tuple[float, float], radius_m: float) -> float:
    """Return the distance [m] from a disc to the nearest of segments (N, 2, 2); 0 or less: contact."""
    return float(distances_m(segments, np.array([place]))[0]) - radius_m
