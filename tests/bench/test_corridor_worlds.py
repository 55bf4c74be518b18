"""Corridors of the obstacle benchmark: who crosses the robot's way has a way through the walls, and comes into it."""

from __future__ import annotations

import random

import numpy as np
import pytest

from omnid.simulation.clearance import clearance_m, footprints
from omnid.simulation.world_file import World, WorldOptions, parse_world
from tests.bench.corridor_worlds import CROSSING, DOOR_M, LIKE_FLOOR, like_the_floor, world_text

HALF_PERSON_M = 0.25
HEIGHT_M = 1.2  # of the robot: lower parts are obstacles


def world(case: str, seed: int) -> World:
    return parse_world(world_text(case, random.Random(seed)), case, seed, WorldOptions())


@pytest.mark.parametrize("case", CROSSING)
@pytest.mark.parametrize("seed", range(1, 4))
def test_who_crosses_comes_into_the_way_and_meets_no_wall(case: str, seed: int) -> None:
    made = world(case, seed)
    walls = footprints(made.standing, HEIGHT_M)
    assert len(made.people) == 1 + (case == "two people cross")
    for person in made.people:
        times = np.linspace(0.0, 10.0 / person.speed_mps, 300)
        places = np.array([person.place(at_s)[:2] for at_s in times])
        assert np.abs(places[:, 1]).min() < 0.15 and abs(places[0, 1]) > 1.0
        assert min(clearance_m(walls, (x, y), HALF_PERSON_M) for x, y in places) > 0.0
        assert (np.sign(places[-1, 1]) == np.sign(places[0, 1])) == (case == "person turns round")
    sides = {np.sign(person.path[0][1]) for person in made.people}
    assert len(sides) == len(made.people), "two come from both sides"


@pytest.mark.parametrize("seed", range(1, 4))
def test_a_door_is_as_wide_as_it_says_and_the_person_behind_it(seed: int) -> None:
    (person,) = (made := world("person from a door", seed)).people
    (x_m, begins_m), _ = person.path
    walls = footprints(made.standing, HEIGHT_M)
    along = walls[np.abs(walls[:, 0, 1] - walls[:, 1, 1]) < 1e-6]
    between = along[np.abs(along[:, 0, 1]) < abs(begins_m)]
    ends = np.sort(between[..., 0], axis=1)
    assert len(ends) == 2 and np.sign(between[0, 0, 1]) == np.sign(begins_m)
    first, second = ends[np.argsort(ends[:, 0])]
    assert second[0] - first[1] == pytest.approx(DOOR_M) and (first[1] + second[0]) / 2 == pytest.approx(x_m)


def test_who_is_like_the_floor_has_its_grey_and_no_texture() -> None:
    made = like_the_floor(world(LIKE_FLOOR, 1))
    floor = next(part for part in made.standing if part.name == "floor")
    for face in made.people[0].faces:
        assert face.texture.std() == 0
        assert face.texture[0, 0] * face.brightness == pytest.approx(floor.texture.mean() * floor.brightness, abs=1.0)
