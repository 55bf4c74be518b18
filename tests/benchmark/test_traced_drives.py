"""Another renderer shows the same world, and a script ends once the robot has stopped before something."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from omnid.controller.statistics import ControllerState
from omnid.core.control.heading_controller import Setpoint
from omnid.simulation.cameras import SimulatedCameras
from omnid.simulation.lockstep import Moment
from omnid.simulation.rendering.surfaces import Scene
from tests.benchmark.fine_robot import fine_robot
from tests.benchmark.obstacle_stops import TILES, world_of
from tests.benchmark.traced_drives import TracedCameras, UntilAtRest
from tests.experiments.povray import INSTALL, available

SAMPLES = 3


@pytest.mark.skipif(not available(), reason=f"povray is missing: {INSTALL}")
def test_traced_images_are_those_of_the_own_renderer_and_so_is_what_a_floor_mirrors(tmp_path: Path) -> None:
    robot, (world, _) = fine_robot(128), world_of("polished box", 3, TILES)
    images = []
    for seen in (replace(world, is_polished=False), world):
        parts = robot.rig, robot.sensor, seen, 1, SAMPLES
        made = SimulatedCameras(*parts), TracedCameras(*parts, folder=tmp_path)
        images.append([one.ideal("lower", Scene(world.standing), robot.rig.T_base_rig) for one in made])
    inner = robot.rig.lower.visible.contains(np.argwhere(images[0][0] > -1)[:, ::-1].astype(float)).reshape(128, 128)
    (own, traced), (own_polished, traced_polished) = ([image[inner] for image in pair] for pair in images)
    assert np.corrcoef(own, traced)[0, 1] > 0.98
    assert np.corrcoef(own_polished - own, traced_polished - traced)[0, 1] > 0.5  # a share for all angles, and by angle


def test_a_script_ends_two_seconds_after_the_robot_has_stopped() -> None:
    script = UntilAtRest(lambda _: [Setpoint(0.5, 0.0)])
    ended = [time_s for time_s in np.arange(0.0, 8.0, 0.1) if "end" in script(_moment(time_s))]
    assert ended[0] == pytest.approx(5.1, abs=0.11)


def _moment(time_s: float) -> Moment:
    """Return that of a robot which stands for 1 s, drives for 2 s at 0.5 m/s, and stands again."""
    T = np.eye(4)
    T[0, 3] = 0.5 * np.clip(time_s - 1.0, 0.0, 2.0)
    return Moment(time_s, T, ControllerState(), None, np.eye(4), None, None)
