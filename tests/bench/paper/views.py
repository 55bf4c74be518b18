"""The panoramas that omnid's own stages make of a rendered log, with the scene that it was rendered from."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from calib import se3
from calib.models.camera import Array
from calib.rig_file import read_rig
from drivers.logs.log_reader import LogReader
from omnid.config import Config
from omnid.messages import Panoramas
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry, geometry
from omnid.stages.synchronise import Synchronise
from tests.bench.paper.scenes import build
from tests.simulation.recipes import SimulatedRun

DESCRIPTION = "experiment.json"
RENDERERS = ("povray", "ray_caster")


@dataclass(frozen=True, slots=True)
class Experiment:
    """The origin of a rendered log: scene, seed, size and renderer."""

    name: str
    seed: int
    size: int
    pairs: int
    renderer: str = "povray"  # one of RENDERERS

    @property
    def run(self) -> SimulatedRun:
        """Rig, path and scene."""
        return build(self.name, self.seed, self.size, self.pairs)

    @property
    def label(self) -> str:
        """The folder's name, as in two_walls_s11; two_walls_s11_ray_caster where POV-Ray did not render it."""
        suffix = "" if self.renderer == "povray" else f"_{self.renderer}"
        return f"{self.name}_s{self.seed}{suffix}"

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
    """The panoramas of a log and their geometry."""

    geometry: Geometry
    panoramas: list[Panoramas]

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


def load_views(folder: Path) -> Views:
    """Return all panoramas of a short log, whose rig has the masks."""
    config = Config()
    place = geometry(read_rig(folder / "rig.toml"), config.panorama)
    pairing, dewarp = Synchronise(place.rig, config.pair), Dewarp(place, config.panorama)
    with closing(LogReader(folder / "log.mcap")) as reader:
        pairs = [pair for frame in reader.frames() if (pair := pairing.process(frame)) is not None]
    return Views(place, [dewarp.process(pair) for pair in pairs])
