"""Rendered worlds with exact truth: scenes, rigs, paths and the logs a robot would have recorded in them."""

from tests.scenes.builders import box, corridor, posters, room, wall
from tests.scenes.caster import render, render_grey
from tests.scenes.logs import camchain, tum, write_log
from tests.scenes.recipes import RECIPES, Run, build
from tests.scenes.rigs import make_rig
from tests.scenes.sensor import Exposure, Sensor
from tests.scenes.surfaces import Rectangle, Scene

__all__ = ["RECIPES", "Exposure", "Rectangle", "Run", "Scene", "Sensor", "box", "build", "camchain", "corridor",
           "make_rig", "posters", "render", "render_grey", "room", "tum", "wall", "write_log"]
