"""Images of a simulated robot as real lenses, lamps and cameras make them, for drives in lock-step."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Final

import numpy as np

from drivers.frame import CAMERAS, Frame
from omnid.simulation.rendering.sensor import Sensor
from omnid.simulation.robot import SimulatedRobot
from tests.simulation.disturbances import DISTURBANCES, Disturbance, DisturbedCamera
from tests.simulation.disturbed import Tamper

# What acts on the scene, or within an exposure, is rendered by tests.simulation only.
OF_SCENES: Final[frozenset[Disturbance]] = frozenset({"gloss", "glass", "windows", "shadows", "motion blur"})
OF_CAMERAS: Final = tuple(name for name in DISTURBANCES if name not in OF_SCENES)


def with_real_lenses(
    robot: SimulatedRobot, seed: int, names: Collection[Disturbance] = OF_CAMERAS
) -> tuple[SimulatedRobot, Tamper]:
    """Return the robot without noise, and what makes its images those of real cameras; the noise is added there."""
    rig = robot.rig
    cameras = {
        name: DisturbedCamera.of(names, number, mounted.visible, mounted.camera.size, seed)
        for number, (name, mounted) in enumerate(zip(CAMERAS, (rig.lower, rig.upper), strict=True))
    }

    def disturbed(time_s: float, frame: Frame) -> Frame:
        camera = cameras[frame.camera]
        light = np.asarray(frame.data, np.float32).reshape(frame.height, frame.width)
        noise = np.random.default_rng([seed, camera.number, frame.seq, 47]).standard_normal(light.shape, np.float32)
        grey = camera.shown(light, frame.seq, time_s) + np.float32(robot.sensor.noise_sigma) * noise
        image = camera.digitised(np.clip(np.rint(grey), 0, 255).astype(np.uint8), frame.seq)
        data = camera.encoded(image, frame.seq)
        return replace(frame, data=image.ravel()) if data is None else replace(frame, encoding="jpeg", data=data)

    noiseless: Sensor = replace(robot.sensor, noise_sigma=0.0)
    return replace(robot, sensor=noiseless), disturbed
