"""The paper's experiments by name: rig, path and world of a seed, and the panoramas of a rendered log."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from calib import se3
from calib.models.camera import Array
from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.logs.log_reader import LogReader
from omnid.config import Config
from omnid.core.types.panorama import Panoramas
from omnid.simulation.rendering.surfaces import CEILING_M, PAINTERS, Rectangle, Scene
from omnid.simulation.world import load_world
from omnid.stages.geometry import Dewarp, Geometry, geometry
from omnid.stages.synchronise import Synchronise
from tests.bench.drive import lap
from tests.simulation import paths, recipes
from tests.simulation.builders import corridor
from tests.simulation.builders import wall as upright
from tests.simulation.recipes import SimulatedRun
from tests.simulation.rigs import make_rig

DESCRIPTION = "experiment.json"  # in the folder of a log
WALL_M = 2.0  # section V.B: distance from the cameras to the wall
WALL_SIZE_M = (9.0, CEILING_M)
TURNS_DEG = tuple(range(0, 181, 9))  # yaw of the pairs after the first, relative to the first pair


def seeded_rig(seed: int, size: int) -> Rig:
    """Return a rig whose mirror scale, baseline and misalignment are random."""
    rng = np.random.default_rng([seed, 23])
    scale, baseline, tilt = rng.uniform((0.9, 0.17, 0.3), (1.05, 0.24, 1.2))
    axis, yaw, x, y = rng.uniform(0, 2 * np.pi), *rng.uniform((-1, -3, -3), (1, 3, 3))
    turned = tilt * np.cos(axis), tilt * np.sin(axis), yaw
    return make_rig(size=size, scale=scale, baseline_m=baseline, misaligned_deg=turned, offset_mm=(x, y))


def facing(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return a run before bricks, a wall named 'wall' (V.B); others are plaster. Pairs are 7 cm apart, sideways."""
    rng = np.random.default_rng([seed, 24])
    half = WALL_SIZE_M[0] / 2
    front = upright(rng, "brick", (WALL_M, half), (WALL_M, -half))
    ends = (((-2.5, half), (WALL_M, half)), ((WALL_M, -half), (-2.5, -half)), ((-2.5, -half), (-2.5, half)))
    others = [upright(rng, "plaster", a, b) for a, b in ends]
    floor = Rectangle(
        np.array([-2.5, half, 0]),
        np.array([WALL_M + 2.5, 0, 0]),
        np.array([0, -2 * half, 0.0]),
        PAINTERS["tiles"](rng, (900, 1800), 200.0),
        "floor",
    )
    scene = Scene((replace(front, name="wall"), *others, floor))
    sideways = np.column_stack([np.zeros(pairs), 0.07 * (np.arange(pairs) - (pairs - 1) / 2)])
    return SimulatedRun(make_rig(size=size), paths.planar_poses(sideways, np.zeros(pairs)), scene)


def two_walls(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return 5 cm steps along a spline between two walls, with a turn of 94 degrees just before the end (V.C)."""
    return replace(recipes.two_walls(seed, size, pairs), rig=seeded_rig(seed, size))


def turns(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return a first pair with yaw 0, and pairs turned left by TURNS_DEG.

    Section IV.F. Tracking from the first pair to another is a turn to the left, the other way a turn to the right.
    """
    angles = np.deg2rad([0, *TURNS_DEG])
    return SimulatedRun(
        seeded_rig(seed, size), paths.planar_poses(np.zeros((len(angles), 2)), angles)[:pairs], corridor(seed)
    )


def building(seed: int, size: int, pairs: int) -> SimulatedRun:
    """Return one round through the corridor of the shipped world `building`, back to its start (section V.D)."""
    line = lap(100.0)
    ahead = np.roll(line, -1, axis=0) - line
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    at, places = np.linspace(0, len(line) - 1, pairs), np.arange(len(line))
    x, y, turned = (np.interp(at, places, values) for values in (*line.T, heading))
    scene = Scene(load_world("building", seed).standing)
    return SimulatedRun(seeded_rig(seed, size), paths.planar_poses(np.column_stack([x, y]), turned), scene)


EXPERIMENTS: dict[str, tuple[Callable[[int, int, int], SimulatedRun], int]] = {  # recipe and number of pairs
    "brick": (facing, 3),
    "two_walls": (two_walls, 99),
    "turns": (turns, 1 + len(TURNS_DEG)),
    "building": (building, 349),
}


def build(name: str, seed: int, size: int = 768, pairs: int | None = None) -> SimulatedRun:
    """Return the run of a name; pairs None: as many as the paper has."""
    recipe, default_pairs = EXPERIMENTS[name]
    return recipe(seed, size, pairs or default_pairs)


@dataclass(frozen=True, slots=True)
class Experiment:
    """The origin of a rendered log: scene, seed, size and number of pairs."""

    name: str
    seed: int
    size: int
    pairs: int

    @property
    def run(self) -> SimulatedRun:
        """Rig, path and scene."""
        return build(self.name, self.seed, self.size, self.pairs)

    @property
    def label(self) -> str:
        """The folder's name, as in two_walls_s11."""
        return f"{self.name}_s{self.seed}"

    def write(self, folder: Path) -> None:
        """Write the description into the folder."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / DESCRIPTION).write_text(json.dumps(asdict(self), indent=1) + "\n")

    @staticmethod
    def read(folder: Path) -> Experiment:
        """Read the description in a folder."""
        return Experiment(**json.loads((folder / DESCRIPTION).read_text()))


@dataclass(frozen=True, slots=True)
class Views:
    """The panoramas that omnid's own stages make of a log, and their geometry."""

    geometry: Geometry
    panoramas: list[Panoramas]

    @staticmethod
    def load(folder: Path) -> Views:
        """Return all panoramas of a short log, whose rig has the masks."""
        config = Config()
        place = geometry(read_rig(folder / "rig.toml"), config.panorama)
        pairing, dewarp = Synchronise(place.rig, config.pair), Dewarp(place, config.panorama)
        with closing(LogReader(folder / "log.mcap")) as reader:
            pairs = [pair for frame in reader.frames() if (pair := pairing.process(frame)) is not None]
        return Views(place, [dewarp.process(pair) for pair in pairs])

    def rays(self, pixels: Array) -> Array:
        """Return rays (N, 3) with r = 1 in the rig frame of panorama pixels (N, 2)."""
        return np.asarray(self.geometry.cylinder.rays(pixels) @ self.geometry.T_rig_rect[:3, :3].T)

    def viewpoint(self, T_world_rig: Array) -> Array:
        """Return the position (3,) of the lower camera's viewpoint in the world."""
        return np.asarray((T_world_rig @ self.geometry.T_rig_rect)[:3, 3])

    def pixels(self, T_world_rig: Array, points: Array) -> Array:
        """Return the panorama pixels (N, 2) of points (N, 3) in the world."""
        T_rect_world = se3.inverse(T_world_rig @ self.geometry.T_rig_rect)
        return self.geometry.cylinder.pixels(se3.apply(T_rect_world, points))
