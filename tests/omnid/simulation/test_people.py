"""People of a simulated world: they walk, and wait for the robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from omnid.simulation.people import Walkers
from omnid.simulation.world_file import load_world
from tests.omnid.simulation.test_world_file import HALL, write


def test_polite_people_wait_until_the_robot_has_gone(tmp_path: Path) -> None:
    polite = HALL.replace('repeat = "back and forth"', "waits_within_m = 0.8")
    people = Walkers(load_world(write(tmp_path, polite), 1).people)
    robot = (0.5, -1.0)  # in the way
    for tenth in range(1, 31):
        people.advance(0.1 * tenth, robot)
    assert -0.35 <= people.places()[0][0] <= -0.3
    for tenth in range(31, 41):
        people.advance(0.1 * tenth, (-0.5, -0.5))  # behind the person, who goes away from it
    assert people.places()[0][0] == pytest.approx(0.2, abs=0.06)


def test_people_walk_and_some_wait_for_the_robot(tmp_path: Path) -> None:
    people = Walkers(load_world(write(tmp_path, HALL), 1).people)
    people.advance(1.0, (-5.0, 0.0))
    assert people.places()[0] == pytest.approx((-0.5, -1.0, 0.0))
    people.advance(5.0, (-5.0, 0.0))
    assert people.places()[0] == pytest.approx((0.5, -1.0, -np.pi))
    assert people.places()[1][:2] == (3.0, 1.5)
    people.advance(6.0, (1.5, 0.5))
    people.advance(6.5, (1.5, 0.5))
    assert people.places()[1][:2] == pytest.approx((3.0, 1.0))
    people.advance(60.0, (-5.0, 0.0))
    assert people.places()[1][:2] == pytest.approx((3.0, 0.5))
