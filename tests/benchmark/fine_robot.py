"""A simulated robot whose images are rendered finely enough that they show what a lens would."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from omnid.simulation.robot import SimulatedRobot, make_robot

# Least number of rays along a side of an image: with two a pixel and axis at 512 px, joints of tiles come and go from
# pixel to pixel, as no lens shows them, and a base stood before them for good; with three they do not.
SIDE_RAYS: Final = 3 * 512


def fine_robot(size_px: int) -> SimulatedRobot:
    """Return a robot with images of a size, of at least SIDE_RAYS rays along a side."""
    return replace(make_robot(size_px), samples=math.ceil(SIDE_RAYS / size_px))
