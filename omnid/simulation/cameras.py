"""Images of both cameras of a simulated robot in its world."""

from __future__ import annotations

import numpy as np

from calib.models.camera import Array
from calib.rig import Rig
from drivers.frame import CAMERAS, Camera, Frame
from omnid.simulation.people import Walkers
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import Floats, MountedSensor, Sensor
from omnid.simulation.rendering.surfaces import Scene
from omnid.simulation.world import World


class SimulatedCameras:
    """Renders raw grey frames; an image follows from world, people, pose, sequence number and seed alone."""

    def __init__(self, rig: Rig, sensor: Sensor, world: World, seed: int, samples: int) -> None:
        """samples: per pixel and axis."""
        self.world, self.samples, self._seed = world, samples, seed
        self.mounted = {"lower": rig.lower, "upper": rig.upper}
        self._sensors = {
            name: MountedSensor.of(sensor, mounted.visible, mounted.camera.size)
            for name, mounted in self.mounted.items()
        }

    def frame(self, camera: Camera, seq: int, stamp_ns: int, T_world_rig: Array, people: Walkers) -> Frame:
        """Return the frame of a camera on a rig at T_world_rig (4, 4)."""
        ideal = self.ideal(camera, T_world_rig, people) * np.float32(self.world.light_at(people.time_s))
        rng = np.random.default_rng([self._seed, 43, CAMERAS.index(camera), seq])
        width, height = self.mounted[camera].camera.size
        sensor = self._sensors[camera]
        image = sensor.expose(ideal, rng)
        if sensor.sensor.is_compressed:
            return Frame(seq, stamp_ns, camera, "jpeg", sensor.jpeg(image), width, height)
        return Frame(seq, stamp_ns, camera, "mono8", image, width, height)

    def ideal(self, camera: Camera, T_world_rig: Array, people: Walkers) -> Floats:
        """Return the image (H, W) without the errors of a sensor."""
        scene = Scene((*self.world.standing, *people.faces()))
        return render_grey(scene, self.mounted[camera], T_world_rig, self.samples)
