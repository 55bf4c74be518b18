"""Worlds like buildings: every name makes a world, and what is rendered stands where the truth says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnid.errors import OmnidError
from omnid.simulation.clearance import clearance_m, obstacles_of, ranges_m
from omnid.simulation.named_worlds import FLOORS, HARMLESS, HAZARDS, trial
from omnid.simulation.trials import can_drive
from omnid.simulation.world_file import load_world

ROBOT_M = 0.2, 1.2  # radius and height
WANTED = {
    *FLOORS,
    *(f"{floor}_hall" for floor in FLOORS),
    *("ramp_2", "ramp_5", "ramp_8", "lean_1deg", "lift_gap", "sun_moving", "light_switch", "dark_and_on", "pushed"),
    *("slip_20", "slip_40", "weak_motor", "trolley_leaves", "person_passes"),
    *("door_80", "door_80_aslant", "office", "clutter", "dead_end_and_back", "doorway_with_person"),
}


def test_the_list_of_harmless_worlds_is_complete() -> None:
    assert set(HARMLESS) == WANTED


@pytest.mark.parametrize("name", sorted(set(HARMLESS) - {f"{floor}_hall" for floor in FLOORS if floor != "plain"}))
def test_nothing_stands_in_the_way_of_harmless_worlds(name: str) -> None:
    asked = trial(name, 1)
    segments = obstacles_of(asked.world, ROBOT_M[1])
    if asked.goal is not None:
        assert can_drive(segments, (0.0, 0.0), asked.goal[:2])
        assert not can_drive(segments, (0.0, 0.0), (30.0, 15.0))
        return
    along = np.arange(0.0, asked.way_m, 0.1)
    assert min(clearance_m(segments, (x_m, 0.0), ROBOT_M[0]) for x_m in along) > 0.2


def test_a_ramp_lifts_and_pitches_the_base() -> None:
    ground = load_world("ramp_5", 1).ground
    begin_m, end_m = (x_m for x_m, _ in ground.profile)
    T = ground.T_world_base(((begin_m + end_m) / 2, 0.0, 0.0))
    assert T[2, 3] == pytest.approx(2.0 * math.tan(math.radians(5.0)), abs=1e-6)
    assert math.degrees(math.asin(T[2, 0])) == pytest.approx(5.0, abs=1e-6)
    backwards = ground.T_world_base(((begin_m + end_m) / 2, 0.0, math.pi))
    assert math.degrees(math.asin(backwards[2, 0])) == pytest.approx(-5.0, abs=1e-6)


def test_the_first_thing_on_a_ray_is_that_of_the_geometry() -> None:
    segments = np.array([[[2.0, -1.0], [2.0, 1.0]], [[3.0, -5.0], [3.0, 5.0]]])
    azimuths = np.radians([0.0, 20.0, 40.0, 180.0])
    assert ranges_m(segments, (0.0, 0.0), azimuths) == pytest.approx(
        [2.0, 2.0 / math.cos(azimuths[1]), 3.0 / math.cos(azimuths[2]), np.inf]
    )


@pytest.mark.parametrize("name", [name for name in HAZARDS if not name.startswith(("plain_", "room_"))])
def test_something_is_in_the_way_of_hazards(name: str) -> None:
    asked = trial(name, 1)
    segments = obstacles_of(asked.world, ROBOT_M[1])
    assert clearance_m(segments, (0.0, 0.0), ROBOT_M[0]) > 0.1
    if name == "steep_ramp":
        assert asked.world.ground.heights_m(asked.way_m) < -0.7
    elif asked.motion == "ahead" and not name.startswith("person"):
        moved = [face for person in asked.world.people for face in person.faces]
        paths = [place for person in asked.world.people for place in person.path]
        first_m = min((x_m for x_m, _ in paths), default=math.inf)
        first_m = min(first_m, float(ranges_m(segments, (0.0, 0.0), np.linspace(-0.1, 0.1, 41)).min()))
        assert 0.3 < first_m < 4.6 and (moved or asked.things is not None)


@pytest.mark.parametrize(
    ("old", "wrong"), [("box", "boxx"), ("edge_8cm", "edge_cm"), ("pole_10percent", "sofa_10percent")]
)
def test_unknown_names_are_refused(old: str, wrong: str) -> None:
    assert trial(old, 1).world.name == old
    with pytest.raises(OmnidError, match=rf"world '{wrong}' is not known"):
        trial(wrong, 1)


@pytest.mark.parametrize("percent", [10, 20])
def test_a_thing_of_a_contrast_has_it_in_the_image(percent: int) -> None:
    asked = trial(f"box_{percent}percent", 1)
    floor = asked.world.standing[0]
    assert asked.things
    for face in asked.things:
        share = float(face.texture.mean()) * face.brightness / (float(floor.texture.mean()) * floor.brightness)
        assert abs(share - 1) == pytest.approx(percent / 100, abs=0.01)
