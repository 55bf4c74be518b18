"""Simulated robots of several builds whose images are rendered finely enough that they show what a lens would."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final, NamedTuple

from calib import se3
from omnid.simulation.robot import BASELINE_M, CAMERA_HEIGHT_M, SimulatedRobot
from tests.simulation.harmless_worlds import SIDE_RAYS
from tests.simulation.rigs import make_rig

# Distances of the configured outline from the disc, as those of the default settings from the default robot.
ALONG_M, ACROSS_M = 0.05, 0.02


class Build(NamedTuple):
    """Dimensions of a robot, and where its cameras are on the base."""

    camera_height_m: float = CAMERA_HEIGHT_M
    baseline_m: float = BASELINE_M
    radius_m: float = 0.2
    height_m: float = 1.2
    ahead_m: float = 0.0
    left_m: float = 0.0
    turned_deg: float = 0.0

    @property
    def settings(self) -> list[str]:
        """Settings of the outline."""
        along_m, across_m = self.radius_m + ALONG_M, self.radius_m + ACROSS_M
        sides = {"front_m": along_m, "rear_m": along_m, "half_width_m": across_m}
        return [f"controller.collision.{name}={side_m:.2f}" for name, side_m in sides.items()]


USUAL: Final = "usual"
BUILDS: Final = {
    USUAL: Build(),
    "low": Build(0.45, 0.12, 0.18, 0.7),
    "lowest": Build(0.3, 0.1, 0.16, 0.5),
    "tall": Build(1.3, 0.2, 0.3, 1.6),
    "mast ahead": Build(ahead_m=0.2, left_m=0.1, turned_deg=35.0),
}


def fine_robot(size_px: int, build: Build = BUILDS[USUAL]) -> SimulatedRobot:
    """Return a robot with images of a size, of at least SIDE_RAYS rays along a side."""
    rig = make_rig(size=size_px, baseline_m=build.baseline_m)
    R_base_rig = se3.rotation_exp([0.0, 0.0, math.radians(build.turned_deg)])
    return SimulatedRobot(
        replace(rig, T_base_rig=se3.transform(R_base_rig, [build.ahead_m, build.left_m, build.camera_height_m])),
        radius_m=build.radius_m,
        height_m=build.height_m,
        samples=math.ceil(SIDE_RAYS / size_px),
    )
