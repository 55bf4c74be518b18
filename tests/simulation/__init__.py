"""Rendered worlds with exact ground truth: scenes, rigs, paths, and logs of a robot in them."""

from omnid.simulation.rendering.ray_caster import Sensor, render_grey
from omnid.simulation.rendering.surfaces import Rectangle, Scene, posters
from tests.simulation.builders import box, corridor, room, wall
from tests.simulation.disturbances import MountedSensor
from tests.simulation.logs import render, tum, write_log
from tests.simulation.recipes import RECIPES, SimulatedRun, build
from tests.simulation.rigs import make_rig

__all__ = [
    "RECIPES",
    "MountedSensor",
    "Rectangle",
    "Scene",
    "Sensor",
    "SimulatedRun",
    "box",
    "build",
    "corridor",
    "make_rig",
    "posters",
    "render",
    "render_grey",
    "room",
    "tum",
    "wall",
    "write_log",
]
