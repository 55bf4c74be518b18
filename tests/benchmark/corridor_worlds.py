"""Corridors with something in the way, as world files, for `obstacle_stops` and `tests.faults images`."""

from __future__ import annotations

import math
import random
from typing import Final

SPEED_MPS: Final = 0.5  # of the robot that people meet
STARTED_S: Final = 0.74  # by which a robot that starts is late against one that drives at SPEED_MPS from 0 s on
POLISHED: Final = "polished "  # the same worlds with a floor that mirrors what stands on it, which is one plane


def world_text(case: str, rng: random.Random) -> str:
    """Return a corridor along x with what the case says in it, as a world file."""
    finish = "polished" if case.startswith(POLISHED) else "matt"
    case = case.removeprefix(POLISHED)
    left, right, length = rng.uniform(0.9, 1.5), -rng.uniform(0.9, 1.5), 12.0
    if case.startswith("person crosses"):
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
    if case.startswith("person crosses"):
        # Unless one of them stops, the person is in the way when the robot comes there, or 0.8 s before at most.
        at_m, side, speed_mps = rng.uniform(2.8, 3.5), rng.choice((1, -1)), rng.uniform(0.8, 1.6)
        aside = side * (room_m - 0.3)
        along_m = rng.choice((-1, 1)) * abs(aside) if case.endswith("diagonally") else 0.0
        before_m = SPEED_MPS * (math.hypot(along_m, aside) / speed_mps + rng.uniform(0.0, 0.8))
        start = f"starts_within_m = {math.hypot(before_m, aside)}"
        if along_m:
            start = f"start_s = {STARTED_S + (at_m - before_m) / SPEED_MPS}"
        path = f"path = [[{at_m - along_m}, {aside}], [{at_m + along_m}, {-aside}]]"
        return ["[[person]]", path, f"speed_mps = {speed_mps}", start]
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
