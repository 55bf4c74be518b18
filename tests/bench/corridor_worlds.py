"""Corridors with something in the way, as world files, for `obstacle_stops` and `tests.bench.faults images`."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from typing import Final

import numpy as np

from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.world import World

SPEED_MPS: Final = 0.5  # of the robot that people meet
STARTED_S: Final = 0.74  # by which a robot that starts is late against one that drives at SPEED_MPS from 0 s on
POLISHED: Final = "polished "  # the same worlds with a floor that mirrors what stands on it, which is one plane
LIKE_FLOOR: Final = "person like the floor"
# Who crosses the way of a robot, in wide rooms.
CROSSING: Final = (
    "person crosses",
    "person crosses diagonally",
    LIKE_FLOOR,
    "two people cross",
    "person from a door",
    "person turns round",
)
DOOR_M: Final = 0.9  # width
DOOR_ASIDE_M: Final = (0.8, 1.2)  # of a wall with a door, from the robot's way


def world_text(case: str, rng: random.Random) -> str:
    """Return a corridor along x with what the case says in it, as a world file."""
    finish = "polished" if case.startswith(POLISHED) else "matt"
    case = case.removeprefix(POLISHED)
    left, right, length = rng.uniform(0.9, 1.5), -rng.uniform(0.9, 1.5), 12.0
    if case in CROSSING:
        left, right = rng.uniform(2.0, 2.6), -rng.uniform(2.0, 2.6)
    walls = [rng.choice(("brick", "granite", "plaster")) for _ in range(2)]
    end = "plain" if case == "white wall" else "brick"
    end_m = rng.uniform(3.5, 4.5) if case == "white wall" else length
    posters = 0.0 if case == "white wall" else 0.6
    lines = [
        "schema = 1",
        "start = [0.0, 0.0, 0.0]",
        "[space]",
        f"low = [-2.0, {right}]",
        f"high = [{end_m}, {left}]",
        f'finish = "{finish}"',
    ]
    corners = [[-2.0, left], [end_m, left], [end_m, right], [-2.0, right]]
    for first, last, texture, per_m in (
        (0, 1, walls[0], 0.6),
        (2, 3, walls[1], 0.6),
        (1, 2, end, posters),
        (3, 0, "brick", 0.0),
    ):
        points = [corners[first], corners[last]]
        lines += ["[[wall]]", f"points = {points}", f'texture = "{texture}"', f"posters_per_m = {per_m}"]
    return "\n".join(lines + _standing(case, rng) + _person(case, rng, min(left, -right))) + "\n"


def _standing(case: str, rng: random.Random) -> list[str]:
    """Return the lines of what stands in the way."""
    if case.endswith("box"):
        size = [rng.uniform(0.25, 0.6), rng.uniform(0.25, 0.6), 0.08 if case == "low box" else rng.uniform(0.4, 1.2)]
        return [
            "[[box]]",
            f"at = [{rng.uniform(2.0, 3.0)}, {rng.uniform(-0.15, 0.15)}]",
            f"size_m = {size}",
            f"yaw_deg = {rng.uniform(-40, 40)}",
        ]
    if case.endswith("pole"):
        side = rng.uniform(0.03, 0.06)
        texture = "white" if case == "plain pole" else "granite"
        return [
            "[[box]]",
            f"at = [{rng.uniform(2.0, 3.0)}, {rng.uniform(-0.15, 0.15)}]",
            f"size_m = [{side}, {side}, 1.8]",
            f'texture = "{texture}"',
            f"yaw_deg = {rng.uniform(-40, 40)}",
        ]
    return []


def _person(case: str, rng: random.Random, room_m: float) -> list[str]:
    """Return the lines of who comes into the way, from either side; room_m: to the nearer wall."""
    if case == "two people cross":
        return _crosses(case, rng, room_m, 1) + _crosses(case, rng, room_m, -1)
    if case in CROSSING:
        return _crosses(case, rng, room_m)
    if case.startswith("person"):
        within_m, side = float(case.split()[2]), rng.choice((1, -1))
        at_m, aside = rng.uniform(2.3, 3.0), side * (room_m - 0.3)
        return [
            "[[person]]",
            f"path = [[{at_m}, {aside}], [{at_m}, {rng.uniform(-0.1, 0.1)}]]",
            f"speed_mps = {rng.uniform(0.8, 1.4)}",
            f"starts_within_m = {within_m + 0.2 + abs(aside) * 0.4}",
        ]
    return []


def _crosses(case: str, rng: random.Random, room_m: float, side: int = 0) -> list[str]:
    """Return the lines of who crosses the way, from a side, 0: either one.

    Unless one of them stops, the person is in the way when the robot comes there, or 0.8 s before at most.
    """
    at_m, chosen, speed_mps = rng.uniform(2.8, 3.5), rng.choice((1, -1)), rng.uniform(0.8, 1.6)
    aside = (side or chosen) * (room_m - 0.3)
    along_m = rng.choice((-1, 1)) * abs(aside) if case.endswith("diagonally") else 0.0
    before_m = SPEED_MPS * (math.hypot(along_m, aside) / speed_mps + rng.uniform(0.0, 0.8))
    start = f"starts_within_m = {math.hypot(before_m, aside)}"
    path = [[at_m - along_m, aside], [at_m + along_m, -aside]]
    lines = []
    if case == "person turns round":
        path = [path[0], [at_m, rng.uniform(-0.1, 0.1)], path[0]]
    if along_m or case == "person turns round":
        start = f"start_s = {STARTED_S + (at_m - before_m) / SPEED_MPS}"
    if case == "person from a door":
        wall_m = math.copysign(rng.uniform(*DOOR_ASIDE_M), aside)
        ends = sorted(([-2.0, wall_m], [12.0, wall_m]), reverse=wall_m < 0)  # from the left to the right of the way
        begins_m = abs(at_m - DOOR_M / 2 - ends[0][0]) - DOOR_M * (wall_m < 0)
        door = f"doors = [{{at_m = {begins_m}, width_m = {DOOR_M}}}]"
        lines = ["[[wall]]", f"points = {ends}", f'texture = "{rng.choice(("brick", "granite", "plaster"))}"', door]
    return [*lines, "[[person]]", f"path = {path}", f"speed_mps = {speed_mps}", start]


def like_the_floor(world: World) -> World:
    """Return the world with people of one grey, that of its floor, so that only what they hide shows them."""
    floor = next(part for part in world.standing if part.name == "floor")
    grey = float(floor.texture.mean()) * floor.brightness

    def painted(face: Rectangle) -> Rectangle:
        value = np.uint8(np.clip(round(grey / face.brightness), 0, 255))
        return replace(face, texture=np.full_like(face.texture, value))

    people = (replace(person, faces=tuple(map(painted, person.faces))) for person in world.people)
    return replace(world, people=tuple(people))
