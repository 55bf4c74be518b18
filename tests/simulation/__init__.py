"""Rendered worlds with exact ground truth: scenes, rigs, paths, and logs of a robot in them."""

from tests.simulation.builders import box, corridor, posters, room, wall
from tests.simulation.logs import camchain, tum, write_log
from tests.simulation.ray_caster import render, render_grey
from tests.simulation.recipes import RECIPES, SimulatedRun, build
from tests.simulation.rigs import make_rig
from tests.simulation.sensor import Exposure, Sensor
from tests.simulation.surfaces import Rectangle, Scene

__all__ = ["RECIPES", "Exposure", "Rectangle", "Scene", "Sensor", "SimulatedRun", "box", "build", "camchain",
           "corridor", "make_rig", "posters", "render", "render_grey", "room", "tum", "wall", "write_log"]
