"""Complete runs by name: a rig, a path, a world and a sensor from one seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from calib.models.camera import Array
from calib.rig import Rig
from omnid.simulation.rendering.ray_caster import Sensor
from omnid.simulation.rendering.surfaces import Scene
from tests.simulation import paths
from tests.simulation.builders import KEPT, bricks, corridor, ring, room, symmetric_room, twin_corridor, two_laps_path
from tests.simulation.disturbances import FlawedSensor
from tests.simulation.rigs import make_rig

TURN_DEG = 94.0
# Mean grey of about 30 of 255; the brightness of each image differs by 20 %.
DIM = FlawedSensor(noise_sigma=5.0, vignette=0.4, flicker=0.2, brightness=0.3)


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    """A rendered run: the arguments of write_log."""

    rig: Rig
    poses: Array  # T_world_rig (N, 4, 4)
    scene: Scene
    sensor: Sensor = field(default_factory=Sensor)


# Makes a run of (seed, image size, pairs).
Recipe = Callable[[int, int, int], SimulatedRun]


@lru_cache(KEPT)
def mild_rig(seed: int, size: int) -> Rig:
    """Return a rig with mirror scale, baseline and a small misalignment that depend on the seed.

    The same rig each time, because the renderer keeps the rays of a rig.
    """
    rng = np.random.default_rng([seed, 7])
    scale, baseline = {1: (0.9, 0.18), 2: (1.0, 0.24)}.get(seed, rng.uniform((0.85, 0.15), (1.05, 0.26)))
    rotation_deg, lower = rng.uniform(0.4, 1.2, 3) * rng.choice([-1, 1], 3), rng.uniform(-0.5, 0.5, 2)
    x, y = rng.uniform(-4, 4, 2)
    return make_rig(
        size=size,
        scale=float(scale),
        baseline_m=float(baseline),
        offset_mm=(x, y),
        misaligned_deg=(rotation_deg[0], rotation_deg[1], rotation_deg[2]),
        lower_misaligned_deg=(lower[0], lower[1], 0.0),
    )


def two_walls(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return the paper's second experiment: 5 cm steps between two walls, a turn of 94 degrees just before the end."""
    poses = paths.spline_path(seed, pairs, 0.05, turn=(max(1, pairs - 2), TURN_DEG))
    return SimulatedRun(mild_rig(seed, size), poses, corridor(seed, max(8.0, 0.05 * pairs + 3.2)))


def misaligned(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return 15 cm steps with cameras rotated about every axis; the rig frame is neither camera's."""
    rig = make_rig(
        size=size,
        scale=0.95,
        baseline_m=0.16,
        misaligned_deg=(1.1, -0.9, 24.0),
        offset_mm=(4.0, -3.0),
        lower_misaligned_deg=(-0.7, 0.6, 25.0),
        lower_offset_mm=(30.0, -20.0),
        centre_px=(1.7, -2.4),
    )
    poses = paths.spline_path(seed, pairs, 0.15)
    return SimulatedRun(rig, poses, corridor(seed, max(8.0, 0.15 * pairs + 3.2)))


def turns(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return turns of 9 to 30 degrees between pairs, to both sides, with a few centimetres of motion."""
    rng = np.random.default_rng([seed, 8])
    angles = np.linspace(9, 30, max(1, pairs - 1)) * rng.choice([-1, 1], max(1, pairs - 1))
    return SimulatedRun(mild_rig(seed, size), paths.turns([float(a) for a in angles[: pairs - 1]]), corridor(seed))


def struts(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return two_walls seen by a mirror on three struts with a hub, vignetting and changing light."""
    run = two_walls(seed, size, pairs)
    sensor = FlawedSensor(strut_angles_deg=(35.0, 155.0, 275.0), hub=0.07, vignette=0.3, flicker=0.03)
    return SimulatedRun(run.rig, run.poses, run.scene, sensor)


def rooms(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return a closed loop through a room with boxes at changing speed, with a little vibration."""
    return SimulatedRun(mild_rig(seed, size), paths.vibrate(paths.loop(seed, pairs), seed, 0.2), room(seed))


def plain(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return bare walls and floor, a few posters and boxes, a tiled ceiling: poses must be reported as degraded."""
    scene = corridor(seed, max(8.0, 0.05 * pairs + 3.2), ("plain",) * 5, posters_per_8m=2)
    return SimulatedRun(mild_rig(seed, size), paths.spline_path(seed, pairs, 0.05), scene)


def spin(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return turns on the spot, 12 degrees a pair."""
    return SimulatedRun(mild_rig(seed, size), paths.turns([12.0] * (pairs - 1), 0.0), corridor(seed))


def two_laps(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return two laps around a block, the second one beside the first, and half of it on the way back."""
    return SimulatedRun(mild_rig(seed, size), paths.vibrate(two_laps_path(seed, pairs), seed, 0.2), ring(seed))


def twin(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return a corridor whose second half repeats the first: no place of one half is a place of the other."""
    return SimulatedRun(mild_rig(seed, size), paths.spline_path(seed, pairs, 0.12, sway_m=0.15), twin_corridor(seed))


def there_and_back(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return a corridor and the way back in it, 0.15 m aside and in the opposite direction."""
    x = 0.15 * np.arange(-(-pairs // 2))
    xy = np.concatenate([np.column_stack([x, 0 * x]), np.column_stack([x[::-1], 0 * x + 0.15])])
    poses = paths.planar_poses(xy, np.repeat([0.0, np.pi], len(x)))[:pairs]
    return SimulatedRun(mild_rig(seed, size), poses, corridor(seed, 0.075 * pairs + 4))


def brick_corridor(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return a corridor of identical bricks, there and back."""
    there = paths.spline_path(seed, max(2, pairs // 2 + 1), 0.1, sway_m=0.15)
    return SimulatedRun(mild_rig(seed, size), paths.back_again(there)[:pairs], bricks(seed, 0.05 * pairs + 4))


def symmetric(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return a loop in an empty room that looks the same after half a turn."""
    return SimulatedRun(mild_rig(seed, size), paths.loop(seed, pairs, 1.3), symmetric_room(seed))


# By name, with the default number of pairs.
RECIPES: dict[str, tuple[Recipe, int]] = {
    "two_walls": (two_walls, 99),
    "misaligned": (misaligned, 33),
    "turns": (turns, 11),
    "struts": (struts, 99),
    "rooms": (rooms, 100),
    "plain": (plain, 60),
    "spin": (spin, 31),
    "two_laps": (two_laps, 384),
    "there_and_back": (there_and_back, 60),
    "twin": (twin, 72),
    "brick_corridor": (brick_corridor, 120),
    "symmetric": (symmetric, 110),
}


def build(name: str, seed: int, size: int = 768, pairs: int | None = None) -> SimulatedRun:
    """Make the run of that name; pairs None: the recipe's default."""
    recipe, usual = RECIPES[name]
    return recipe(seed, size, pairs or usual)
