"""A simulated world: its objects, its people, its light, and the start of the robot."""

from __future__ import annotations

from dataclasses import dataclass

from omnid.simulation.people import Person
from omnid.simulation.rendering.surfaces import Rectangle


@dataclass(frozen=True, slots=True)
class World:
    """The floor is at z = 0 and the robot starts at x, y [m] with a heading [rad]."""

    name: str
    standing: tuple[Rectangle, ...]
    people: tuple[Person, ...] = ()
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    brightness: float = 1.0  # factor on the grey of all images
    is_polished: bool = False  # the floor mirrors the objects on it
