"""Floors of corridors along x that fall at an edge, or by a ramp."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.world import World

Array = NDArray[np.float64]

RAMP_M: Final = 2.0  # seen from above
RAMP_DEG: Final = 20.0


def with_edge(world: World, at_m: float, drop_m: float, ramp_m: float = 0.0) -> tuple[World, Array]:
    """Return the world with its floor lower from a place on along x, and the edge (1, 2, 2).

    ramp_m: way along x over which it falls, evenly.
    """
    standing = []
    for part in world.standing:
        if part.name != "floor":
            standing.append(part)
            continue
        shares = np.array([at_m, at_m + ramp_m] - part.origin[0]) / part.edge_u[0]
        first, second = np.rint(shares * part.texture.shape[1]).astype(int).tolist()
        along, slope, end = (
            part.edge_u * shares[0],
            part.edge_u * (shares[1] - shares[0]),
            part.edge_u * (1 - shares[1]),
        )
        across, down = part.edge_v, np.array([0.0, 0.0, -drop_m])
        top, corner = part.origin + along, part.origin + along + down
        standing += [
            replace(part, edge_u=along, texture=part.texture[:, :first].copy()),
            replace(part, origin=corner + slope, edge_u=end, texture=part.texture[:, second:].copy()),
        ]
        if ramp_m:
            standing += [replace(part, origin=top, edge_u=slope + down, texture=part.texture[:, first:second].copy())]
        # What closes the walls below the old floor.
        standing += [
            Rectangle(first_m - down, way, down, part.texture[:64].copy(), "wall")
            for first_m, way in (
                (corner, slope + end),
                (corner + across, slope + end),
                (corner + slope + end, across),
            )
        ]
        edge = np.array([[top[:2], (top + across)[:2]]])
    return replace(world, standing=tuple(standing)), edge


def with_ramp(world: World, at_m: float) -> World:
    """Return the world with a ramp down along x, which is no edge."""
    return with_edge(world, at_m, RAMP_M * math.tan(math.radians(RAMP_DEG)), RAMP_M)[0]
