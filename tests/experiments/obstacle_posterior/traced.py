"""Pairs of an obstacle scene, ray-traced by POV-Ray: a mirror below a camera, and a floor that mirrors what stands."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.simulation.rendering.surfaces import Scene
from omnid.simulation.robot import SimulatedRobot
from tests.experiments.obstacle_posterior.scenes import ObstacleScene
from tests.experiments.povray import shoot, write_world

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

SAMPLES: Final = 3  # of a pixel, per axis: POV-Ray does not filter textures, and with 2 joints of tiles come and go


class TracedScene:
    """A scene that is written to a folder once; both cameras are traced at the same time."""

    def __init__(self, folder: Path, scene: ObstacleScene, robot: SimulatedRobot) -> None:
        """Write the scene; PovrayError: POV-Ray cannot trace the robot's cameras."""
        self._folder, self._scene, self._rig = folder, scene, robot.rig
        write_world(folder, Scene(scene.rectangles), scene.gloss)

    def pair(self, T_world_base: Array) -> tuple[Floats, Floats]:
        """Return the ideal images of both cameras; PovrayError: POV-Ray is missing or failed."""
        T = T_world_base @ self._rig.T_base_rig
        with ThreadPoolExecutor(2) as pool:
            cameras = self._rig.lower, self._rig.upper
            lower, upper = pool.map(lambda camera: shoot(self._folder, camera, T, SAMPLES), cameras)
        light = np.float32(self._scene.brightness)
        return np.asarray(lower * light, np.float32), np.asarray(upper * light, np.float32)
