"""Worlds like buildings and what stands in them: every name makes a world, whose outlines are where it says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.errors import OmnidError
from omnid.simulation.rendering.shapes import box
from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.world import clearance_m, footprints
from tests.simulation.harmless_worlds import FLOORS, NAMES, can_drive
from tests.simulation.hazard_worlds import HAZARDS, OF_ROBOT, trial

Array = NDArray[np.float64]
ROBOT_M = 0.2, 1.2  # radius and height
ALIKE = {f"{floor}_hall" for floor in FLOORS if floor != "plain"} | set(OF_ROBOT) - {"lean_1deg"}


def ranges_m(segments: Array, place: tuple[float, float], azimuths_rad: Array) -> Array:
    """Return the distances (N,) [m] from a place to the first of segments (M, 2, 2) along azimuths (N,); inf: none."""
    if not len(segments):
        return np.full(len(azimuths_rad), np.inf)
    ray = np.column_stack([np.cos(azimuths_rad), np.sin(azimuths_rad)])
    start, along = segments[:, 0] - place, segments[:, 1] - segments[:, 0]
    across = ray[:, None, 0] * along[:, 1] - ray[:, None, 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance_m = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
        share = (start[:, 0] * ray[:, None, 1] - start[:, 1] * ray[:, None, 0]) / across
    met = (distance_m > 0) & (share >= 0) & (share <= 1)
    return np.asarray(np.where(met, distance_m, np.inf).min(axis=1))


@pytest.mark.parametrize("name", sorted({*NAMES, *OF_ROBOT} - ALIKE))
def test_nothing_stands_in_the_way_of_harmless_worlds(name: str) -> None:
    asked = trial(name, 1)
    segments = asked.world.obstacles(ROBOT_M[1])
    if asked.goal is not None:
        assert can_drive(segments, (0.0, 0.0), asked.goal[:2])
        assert not can_drive(segments, (0.0, 0.0), (30.0, 15.0))
        return
    along = np.arange(0.0, asked.way_m, 0.1)
    assert min(clearance_m(segments, (x_m, 0.0), ROBOT_M[0]) for x_m in along) > 0.2


@pytest.mark.parametrize("name", [name for name in HAZARDS if not name.startswith(("plain_", "room_"))])
def test_something_is_in_the_way_of_hazards(name: str) -> None:
    asked = trial(name, 1)
    segments = asked.world.obstacles(ROBOT_M[1])
    assert clearance_m(segments, (0.0, 0.0), ROBOT_M[0]) > 0.1
    if name == "steep_ramp":
        assert asked.world.ground.heights_m(asked.way_m) < -0.7
    elif asked.motion == "ahead" and not name.startswith("person"):
        paths = [place for person in asked.world.people for place in person.path]
        first_m = min((x_m for x_m, _ in paths), default=math.inf)
        first_m = min(first_m, float(ranges_m(segments, (0.0, 0.0), np.linspace(-0.1, 0.1, 41)).min()))
        assert 0.3 < first_m < 4.6 and (paths or asked.things is not None)


def test_unknown_names_are_refused_and_floors_can_be_exchanged() -> None:
    with pytest.raises(OmnidError, match=r"world 'sofa_10percent' is not known"):
        trial("sofa_10percent", 1)
    on_carpet, own = (trial("lift_gap", 1, floor).world for floor in ("carpet", None))
    assert on_carpet.name == "lift_gap"
    assert not np.array_equal(on_carpet.standing[0].texture, own.standing[0].texture)


@pytest.mark.parametrize("percent", [10, 20])
def test_a_thing_of_a_contrast_has_it_in_the_image(percent: int) -> None:
    asked = trial(f"box_{percent}percent", 1)
    floor = asked.world.standing[0]
    assert asked.things
    for face in asked.things:
        share = float(face.texture.mean()) * face.brightness / (float(floor.texture.mean()) * floor.brightness)
        assert abs(share - 1) == pytest.approx(percent / 100, abs=0.01)


def test_a_ramp_lifts_and_pitches_the_base() -> None:
    world = trial("ramp_5", 1).world
    middle_m = float(np.mean([x_m for x_m, _ in world.ground.profile]))
    for heading_rad, sign in ((0.0, 1), (math.pi, -1)):
        T = world.T_world_base((middle_m, 0.0, heading_rad))
        assert T[2, 3] == pytest.approx(2.0 * math.tan(math.radians(5.0)), abs=1e-6)
        assert math.degrees(math.asin(T[2, 0])) == pytest.approx(sign * 5.0, abs=1e-6)


def upright(height_m: float, from_m: float = 0.0) -> Rectangle:
    """Return a wall along x from 0 to 2 at y 1."""
    top = np.array([0.0, 1.0, from_m + height_m])
    return Rectangle(top, np.array([2.0, 0, 0]), np.array([0, 0, -height_m]), np.zeros((8, 8), np.uint8), "wall")


def test_the_clearance_is_that_of_the_outline_from_what_is_neither_driven_over_nor_under() -> None:
    for wall in (upright(0.01), upright(1.0, from_m=0.6)):
        assert footprints([wall], 0.5).shape == (0, 2, 2)
    assert clearance_m(np.zeros((0, 2, 2)), (1.0, 1.0), 0.2) == np.inf
    segments = footprints([upright(1.0)], 0.5)
    assert clearance_m(segments, (1.0, 0.0), 0.2) == pytest.approx(0.8)
    assert clearance_m(segments, (3.0, 1.0), 0.2) == pytest.approx(0.8) and clearance_m(segments, (1.0, 0.9), 0.2) < 0
    around = footprints(box(np.random.default_rng(1), (5.0, 5.0), (1.0, 1.0, 0.5), 0.0), 0.4)
    assert clearance_m(around, (5.0, 3.5), 0.2) == pytest.approx(0.8)


def test_the_first_thing_on_a_ray_is_that_of_the_geometry() -> None:
    segments = np.array([[[2.0, -1.0], [2.0, 1.0]], [[3.0, -5.0], [3.0, 5.0]]])
    azimuths = np.radians([0.0, 20.0, 40.0, 180.0])
    expected = [2.0, 2.0 / math.cos(azimuths[1]), 3.0 / math.cos(azimuths[2]), np.inf]
    assert ranges_m(segments, (0.0, 0.0), azimuths) == pytest.approx(expected)
