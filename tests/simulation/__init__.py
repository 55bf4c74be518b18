"""Rendered worlds with exact truth: scenes, rigs, paths and the logs a robot would have recorded in them."""

from tests.simulation.builders import box, corridor, posters, room, wall
from tests.simulation.logs import camchain, tum, write_log
from tests.simulation.ray_caster import render, render_grey
from tests.simulation.recipes import RECIPES, Run, build
from tests.simulation.rigs import make_rig
from tests.simulation.sensor import Exposure, Sensor
from tests.simulation.surfaces import Rectangle, Scene

__all__ = ["RECIPES", "Exposure", "Rectangle", "Run", "Scene", "Sensor", "box", "build", "camchain", "corridor",
           "make_rig", "posters", "render", "render_grey", "room", "tum", "wall", "write_log"]
