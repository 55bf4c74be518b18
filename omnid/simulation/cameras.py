"""Images of both cameras of a simulated robot in its world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.rig import Rig
from drivers.frame import CAMERAS, Camera, Frame
from omnid.simulation.people import Walkers
from omnid.simulation.rendering.mirrors import PANES, Mirror, seen_part
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import Floats, MountedSensor, Sensor
from omnid.simulation.rendering.surfaces import Scene
from omnid.simulation.world import World

Array = NDArray[np.float64]


class SimulatedCameras:
    """Renders raw grey frames; an image follows from world, people, pose, sequence number and seed alone."""

    def __init__(self, rig: Rig, sensor: Sensor, world: World, seed: int, samples: int) -> None:
        """samples: per pixel and axis."""
        self._world, self._seed, self._samples = world, seed, samples
        self._mounted = {"lower": rig.lower, "upper": rig.upper}
        self._sensors = {
            name: MountedSensor.of(sensor, mounted.visible, mounted.camera.size)
            for name, mounted in self._mounted.items()
        }
        self._mirrors = {name: Mirror(mounted) for name, mounted in self._mounted.items()}

    def frame(
        self, camera: Camera, seq: int, stamp_ns: int, T_world_rig: Array, people: Walkers, *, brightness: float = 1.0
    ) -> Frame:
        """Return the frame of a camera on a rig at T_world_rig (4, 4)."""
        scene = Scene((*self._world.standing, *people.faces()))
        light = np.float32(brightness * self._world.light_at(people.time_s))
        ideal = self.ideal(camera, scene, T_world_rig)
        for patch in self._world.sun:
            lit = patch.rectangle(people.time_s, PANES)
            shown = seen_part(lit, scene.rectangles, self._mounted[camera], T_world_rig, self._samples)
            ideal = np.asarray(ideal * (1 + np.float32(patch.gain) * shown), np.float32)
        rng = np.random.default_rng([self._seed, 43, CAMERAS.index(camera), seq])
        width, height = self._mounted[camera].camera.size
        sensor = self._sensors[camera]
        image = sensor.expose(ideal * light, rng)
        if sensor.sensor.is_compressed:
            return Frame(seq, stamp_ns, camera, "jpeg", sensor.jpeg(image), width, height)
        return Frame(seq, stamp_ns, camera, "mono8", image, width, height)

    def ideal(self, camera: Camera, scene: Scene, T_world_rig: Array) -> Floats:
        """Return the image (H, W) of a scene without the errors of a sensor; another renderer replaces this."""
        ideal = render_grey(scene, self._mounted[camera], T_world_rig, self._samples)
        floors = [face for face in scene.rectangles if face.name == "floor"][: self._world.is_polished]
        for surface in (*floors, *self._world.panes):
            ideal = self._mirrors[camera].reflected(ideal, scene, surface, T_world_rig, self._samples)
        return ideal
