"""What omnid's own stages make of a rendered log, beside the scene it was rendered from."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from calib import se3
from calib.models.camera import Array
from calib.rig_file import read_rig
from drivers.logs.mcap_reader import LogReader
from omnid.config import Config
from omnid.messages import FramePair, Panoramas
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry, geometry
from omnid.stages.synchronise import Synchronise
from tests.experiments.scenes import RigOptions, build
from tests.simulation.recipes import Run

ORIGIN = "experiment.json"


@dataclass(frozen=True, slots=True)
class Experiment:
    """What a folder was rendered from."""

    name: str
    seed: int
    size: int
    pairs: int
    options: RigOptions

    @property
    def run(self) -> Run:
        """Rig, path and scene."""
        return build(self.name, self.seed, self.size, self.pairs, self.options)

    @property
    def label(self) -> str:
        """The folder's own name, as in two_walls_s11."""
        return f"{self.name}_s{self.seed}"

    def write(self, folder: Path) -> None:
        """Leaves a note in the folder."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ORIGIN).write_text(json.dumps(asdict(self), indent=1) + "\n")

    @staticmethod
    def read(folder: Path) -> Experiment:
        """The note of a folder."""
        noted = json.loads((folder / ORIGIN).read_text())
        return Experiment(**(noted | {"options": RigOptions(**noted["options"])}))


@dataclass(frozen=True, slots=True)
class Views:
    """The panoramas of a log."""

    place: Geometry
    panoramas: list[Panoramas]

    def rays(self, pixels: Array) -> Array:
        """Rays (N, 3), r = 1, in the rig frame of panorama pixels (N, 2)."""
        return np.asarray(self.place.cylinder.rays(pixels) @ self.place.T_rig_rect[:3, :3].T)

    def viewpoint(self, T_world_rig: Array) -> Array:
        """Where the lower camera's viewpoint (3,) is in the world."""
        return np.asarray((T_world_rig @ self.place.T_rig_rect)[:3, 3])

    def pixels(self, T_world_rig: Array, points: Array) -> Array:
        """Panorama pixels (N, 2) of points (N, 3) in the world."""
        T_rect_world = se3.inverse(T_world_rig @ self.place.T_rig_rect)
        return self.place.cylinder.pixels(se3.apply(T_rect_world, points))


def look(folder: Path) -> Views:
    """All panoramas of a short log."""
    config = Config()
    place = geometry(read_rig(folder / "rig.toml"), config.panorama)
    dewarp = Dewarp(place, config.panorama)
    return Views(place, [dewarp.process(pair) for pair in _pairs(folder, place, config)])


def _pairs(folder: Path, place: Geometry, config: Config) -> Iterator[FramePair]:
    sync, reader = Synchronise(place.rig, config.pair), LogReader(folder / "log.mcap")
    try:
        yield from (pair for frame in reader.frames() if (pair := sync.process(frame)) is not None)
    finally:
        reader.close()
