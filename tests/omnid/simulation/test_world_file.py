"""World files: what they describe stands and walks there, and wrong ones are refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from omnid.errors import OmnidError
from omnid.simulation.rendering import shapes
from omnid.simulation.world import Walkers, clearance_m
from omnid.simulation.world_file import WorldOptions, load_world, shipped_worlds

HALL = """
schema = 1
start = [0.0, 0.0, 90.0]
[space]
low = [-2.0, -2.0]
high = [4.0, 2.0]
[[wall]]
points = [[2.0, 1.0], [2.0, -1.0]]
texture = "white"
[[wall.doors]]
at_m = 0.5
width_m = 0.9
[[box]]
at = [0.0, 1.0]
size_m = [0.4, 0.2, 0.5]
texture = "granite"
[[person]]
path = [[-1.0, -1.0], [1.0, -1.0]]
speed_mps = 0.5
repeat = "back and forth"
[[person]]
path = [[3.0, 1.5], [3.0, 0.5]]
starts_within_m = 2.0
"""


def write(folder: Path, text: str) -> str:
    path = folder / "hall.toml"
    path.write_text(text, "utf-8")
    return str(path)


def test_walls_have_doors_and_boxes_have_outlines(tmp_path: Path) -> None:
    world = load_world(write(tmp_path, HALL), 1)
    assert world.start == pytest.approx((0.0, 0.0, np.pi / 2))
    segments = world.obstacles(1.2)
    assert clearance_m(segments, (2.0, 0.05), 0.2) == pytest.approx(0.25)  # in the door: 0.45 m to either side
    assert clearance_m(segments, (2.0, 0.8), 0.2) == pytest.approx(-0.2)  # in the wall
    assert clearance_m(segments, (0.0, 0.0), 0.2) == pytest.approx(0.7)
    assert clearance_m(world.obstacles(2.5), (2.0, 0.05), 0.2) == pytest.approx(-0.2)  # the lintel
    raised = load_world(write(tmp_path, HALL.replace("[0.4, 0.2, 0.5]", "[0.4, 0.2, 0.5]\nbottom_m = 1.3")), 1)
    assert clearance_m(raised.obstacles(1.2), (0.0, 1.0), 0.2) > 0.5  # below the box


@pytest.mark.parametrize("name", shipped_worlds())
def test_shipped_worlds_are_drawn_from_a_seed(name: str) -> None:
    one, same, other = load_world(name, 1), load_world(name, 1), load_world(name, 2)
    assert all(np.array_equal(a.texture, b.texture) for a, b in zip(one.standing, same.standing, strict=True))
    assert not all(np.array_equal(a.texture, b.texture) for a, b in zip(one.standing, other.standing, strict=False))
    assert clearance_m(one.obstacles(1.2), one.start[:2], 0.2) > 0.3


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 1", "schema = 2", "schema"),
        ('texture = "white"', 'texture = "whit"', "wall\\[0\\].texture: expected one of"),
        ("at_m = 0.5", "at = 0.5", "unknown key"),
        ("high = [4.0, 2.0]", "high = [-1.9, 2.0]", "space.high"),
        ("size_m = [0.4, 0.2, 0.5]", "size_m = [0.4, 0.2]", "box\\[0\\].size_m"),
        (
            "path = [[3.0, 1.5], [3.0, 0.5]]",
            "path = [[3.0, 1.5]]",
            "person\\[1\\].path: expected rows of numbers, 2 to 100 of them",
        ),
        ("[space]", "[space", "expected TOML"),
        (
            "at = [0.0, 1.0]",
            "at = [0.15, 0.0]",
            "box\\[0\\].at: expected a place where the robot does not start inside",
        ),
        ("at = [0.0, 1.0]", "at = [0.0, 0.15]\nyaw_deg = 90.0", "the robot does not start inside"),
        ("at = [0.0, 1.0]", "at = [0.0, 5.0]", "box\\[0\\].at: expected a place where the whole box is within"),
        ("at = [0.0, 1.0]", "at = [0.0, 1.85]\nyaw_deg = 90.0", "the whole box is within"),
        ("start = [0.0, 0.0, 90.0]", "start = [0.0, 2.1, 90.0]", "start: expected a place within"),
    ],
)
def test_wrong_worlds_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(OmnidError, match=message):
        load_world(write(tmp_path, HALL.replace(old, new)), 1)


def test_unknown_worlds_and_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OmnidError, match=r"world 'castle' is not known; name a file \*.toml, or one of .*room"):
        load_world("castle", 1)
    with pytest.raises(OmnidError, match="cannot be read"):
        load_world(str(tmp_path / "none.toml"), 1)
    with pytest.raises(OmnidError, match="brightness 9"):
        WorldOptions(brightness=9.0)


@pytest.mark.parametrize(
    "text",
    [
        HALL.replace("[4.0, 2.0]", "[24.0, 22.0]") + 199 * "[[box]]\nat = [12.0, 11.0]\nsize_m = [20.0, 20.0, 20.0]\n",
        HALL + 18 * "[[person]]\npath = [[0.0, 0.0], [1.0, 0.0]]\nsize_m = [20.0, 20.0, 20.0]\n",
        HALL.replace("[[2.0, 1.0], [2.0, -1.0]]", "[[2.0, 1.0], [2.0, -1e9]]"),
    ],
)
def test_the_area_is_checked_before_anything_is_painted(
    tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shapes.textures, "PAINTERS", {name: None for name in shapes.textures.PAINTERS})
    monkeypatch.setattr(shapes.textures, "poster", None)
    with pytest.raises(OmnidError, match=r"the surfaces are \d+ m2; expected at most 1200"):
        load_world(write(tmp_path, text), 1)


def test_polite_people_wait_until_the_robot_has_gone(tmp_path: Path) -> None:
    polite = HALL.replace('repeat = "back and forth"', "waits_within_m = 0.8")
    people = Walkers(load_world(write(tmp_path, polite), 1).people)
    for tenth in range(1, 31):
        people.advance(0.1 * tenth, (0.5, -1.0))  # in the way
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
