"""Furniture stands in the way of the robot, within its height, and in one grey where it is plain."""

from __future__ import annotations

import random

import numpy as np
import pytest

from omnid.simulation.clearance import footprints
from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.world import World
from tests.bench.furniture import AHEAD_M, PLAIN, THINGS, with_furniture
from tests.bench.obstacle_stops import room_ahead_m

NOWHERE = World("nowhere", ())
HEIGHT_M, RADIUS_M = 1.2, 0.2


@pytest.mark.parametrize("kind", THINGS)
def test_a_thing_is_in_the_way(kind: str) -> None:
    for seed in range(2):
        world = with_furniture(NOWHERE, kind, random.Random(seed))
        room_m = room_ahead_m(footprints(world.standing, HEIGHT_M), (0.0, 0.0, 0.0), RADIUS_M)
        assert AHEAD_M[0] - 1.0 < room_m < AHEAD_M[1] + 0.6
        assert min(face.corners[:, 2].min() for face in world.standing) >= -1e-9


@pytest.mark.parametrize("name", THINGS)
def test_a_plain_thing_has_one_grey(name: str) -> None:
    greys = {value for face in _faces(PLAIN + name) for value in np.unique(face.texture).tolist()}
    assert len(greys) == 1
    assert len({value for face in _faces(name) for value in np.unique(face.texture).tolist()}) > 1


def test_a_turned_box_keeps_its_sides() -> None:
    """A block is the only thing of one box, so its sides are those that its seed draws."""
    for face in _faces("block"):
        assert abs(float(face.edge_u @ face.edge_v)) < 1e-9
        assert 0.14 < min(face.width_m, face.height_m) < max(face.width_m, face.height_m) < 0.61


def _faces(kind: str) -> tuple[Rectangle, ...]:
    return with_furniture(NOWHERE, kind, random.Random(3)).standing
