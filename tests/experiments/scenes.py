"""The paper's scenes by name: a rig, a path and a world from one seed, for POV-Ray to render."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib.rig import Rig
from tests.experiments.building import building, round_trip
from tests.simulation import paths
from tests.simulation.builders import CEILING_M, corridor
from tests.simulation.builders import wall as upright
from tests.simulation.recipes import TURN_DEG, Run
from tests.simulation.rigs import RIM, make_rig
from tests.simulation.surfaces import Rectangle, Scene
from tests.simulation.textures import PAINTERS

WALL_M = 2.0  # section V.B: from the cameras to the wall
WALL_SIZE_M = (9.0, CEILING_M)
TURNS_DEG = tuple(range(0, 181, 9))  # of the second image of each pair of images
MOVED_TURNS_DEG = (18, 45, 90, 135, 180)  # the same with a small translation
MOVED_M = (0.05, 0.03)


@dataclass(frozen=True, slots=True)
class RigOptions:
    """What may be asked of a rig; None leaves it to the seed."""

    scale: float | None = None  # radius of the horizon in the image, 1 = 27 % of its width
    baseline_m: float | None = None
    misaligned: float | None = None  # how far from straight: 0 not at all, 1 up to 1.2 deg and 4 mm
    xi: float = 1.0  # 1: parabolic mirrors; below: hyperbolic ones under perspective cameras


def seeded_rig(seed: int, size: int, options: RigOptions) -> Rig:
    """A rig with a mirror scale, a baseline and a misalignment by chance, where the options leave it."""
    rng = np.random.default_rng([seed, 23])
    scale, baseline, tilt = rng.uniform((0.9, 0.17, 0.3), (1.05, 0.24, 1.2))
    axis, yaw, x, y = rng.uniform(0, 2 * np.pi), *rng.uniform((-1, -3, -3), (1, 3, 3))
    misaligned = 1.0 if options.misaligned is None else options.misaligned
    turned = misaligned * np.array([tilt * np.cos(axis), tilt * np.sin(axis), yaw])
    # A hyperbolic mirror of the same image shows less above the horizon: a smaller rim keeps the rays this side.
    rim = RIM if options.xi == 1 else min(RIM, 0.45)
    return make_rig(size=size, scale=options.scale or scale, baseline_m=options.baseline_m or baseline, rim=rim,
                    xi=options.xi, misaligned_deg=tuple(turned), offset_mm=(misaligned * x, misaligned * y))


def _paper_rig(seed: int, size: int, options: RigOptions) -> Rig:
    """The paper's own, with heights of 1.2 m and 1.4 m, and straight, where the options leave it."""
    misaligned = 0.0 if options.misaligned is None else options.misaligned
    return seeded_rig(seed, size, replace(options, scale=options.scale or 1.0, baseline_m=options.baseline_m or 0.2,
                                          misaligned=misaligned))


def brick(seed: int, size: int, pairs: int, options: RigOptions) -> Run:
    """V.B: a wall of bricks that look exactly alike, straight ahead."""
    return _facing(seed, size, pairs, options, "brick")


def control(seed: int, size: int, pairs: int, options: RigOptions) -> Run:
    """The same wall with a texture that does not repeat."""
    return _facing(seed, size, pairs, options, "granite")


def _facing(seed: int, size: int, pairs: int, options: RigOptions, kind: str) -> Run:
    """One wall WALL_M ahead, named 'wall'; plaster and tiles elsewhere. Pairs stand side by side, 7 cm apart."""
    rng = np.random.default_rng([seed, 24])
    half = WALL_SIZE_M[0] / 2
    front = upright(rng, kind, (WALL_M, half), (WALL_M, -half))
    ends = (((-2.5, half), (WALL_M, half)), ((WALL_M, -half), (-2.5, -half)), ((-2.5, -half), (-2.5, half)))
    others = [upright(rng, "plaster", a, b) for a, b in ends]
    floor = Rectangle(np.array([-2.5, half, 0]), np.array([WALL_M + 2.5, 0, 0]), np.array([0, -2 * half, 0.0]),
                      PAINTERS["tiles"](rng, (900, 1800), 200.0), "floor")
    scene = Scene((replace(front, name="wall"), *others, floor))
    aside = np.column_stack([np.zeros(pairs), 0.07 * (np.arange(pairs) - (pairs - 1) / 2)])
    return Run(_paper_rig(seed, size, options), paths.planar_poses(aside, np.zeros(pairs)), scene)


def two_walls(seed: int, size: int, pairs: int, options: RigOptions) -> Run:
    """V.C: 5 cm steps along a spline between two walls, a turn of 94 degrees just before the end."""
    poses = paths.spline_path(seed, pairs, 0.05, turn=(max(1, pairs - 2), TURN_DEG))
    return Run(seeded_rig(seed, size, options), poses, corridor(seed, max(8.0, 0.05 * pairs + 3.2)))


def turns(seed: int, size: int, pairs: int, options: RigOptions) -> Run:
    """IV.F: the first pair looks ahead; each other one stands turned by TURNS_DEG, then MOVED_TURNS_DEG and moved."""
    angles = np.deg2rad([0, *TURNS_DEG, *MOVED_TURNS_DEG])
    xy = np.zeros((len(angles), 2))
    xy[-len(MOVED_TURNS_DEG):] = MOVED_M
    return Run(seeded_rig(seed, size, options), paths.planar_poses(xy, angles)[:pairs], corridor(seed))


def building_run(seed: int, size: int, pairs: int, options: RigOptions) -> Run:
    """V.D: once around the corridor of a building, back to where it began."""
    plan, scene = building(seed)
    return Run(seeded_rig(seed, size, options), round_trip(seed, plan, pairs), scene)


Recipe = Callable[[int, int, int, RigOptions], Run]
EXPERIMENTS: dict[str, tuple[Recipe, int]] = {  # and how many pairs each has
    "brick": (brick, 3), "control": (control, 3), "two_walls": (two_walls, 99),
    "turns": (turns, 1 + len(TURNS_DEG) + len(MOVED_TURNS_DEG)), "building": (building_run, 349),
}


def build(name: str, seed: int, size: int = 768, pairs: int | None = None, options: RigOptions | None = None) -> Run:
    """The run of that name."""
    recipe, usual = EXPERIMENTS[name]
    return recipe(seed, size, pairs or usual, options or RigOptions())
