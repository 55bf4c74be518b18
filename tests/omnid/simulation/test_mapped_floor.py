"""A map of a drive past a box that is lower than what stereo tells from floor, and a white pole: neither is free."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omnid.config import load_config
from omnid.core.mapping.scan_grid import FREE, UNKNOWN
from omnid.core.places.place_views import grid
from omnid.formats.place_file import read_places
from omnid.simulation.lockstep import simulate
from omnid.simulation.world_file import load_world
from tests.bench.fine_robot import fine_robot
from tests.bench.obstacles import ahead

BOX_M = (1.6, 0.75), (0.4, 0.4, 0.08)  # its middle, and its sides
POLE_M = (1.3, -0.8), (0.06, 0.06, 1.8)
SECONDS = 7.0
WORLD = f"""
schema = 1
start = [0.0, 0.0, 0.0]
[space]
low = [-2.0, -1.3]
high = [6.0, 1.3]
[[wall]]
points = [[-2.0, -1.3], [-2.0, 1.3], [6.0, 1.3], [6.0, -1.3], [-2.0, -1.3]]
texture = "granite"
[[box]]
at = {list(BOX_M[0])}
size_m = {list(BOX_M[1])}
[[box]]
at = {list(POLE_M[0])}
size_m = {list(POLE_M[1])}
texture = "white"
"""


def test_the_floor_that_was_driven_is_free_and_a_low_box_and_a_white_pole_beside_it_are_not(tmp_path: Path) -> None:
    (tmp_path / "world.toml").write_text(WORLD)
    world, map_file = load_world(str(tmp_path / "world.toml"), 1), tmp_path / "m.omap"
    run = simulate(
        world, fine_robot(384), ahead, seconds=SECONDS, config=load_config(None, [f'places.map="{map_file}"'])
    )
    assert run.ticks[-1].pose[0] > 1.8 and not run.contacts
    places, rig = read_places(map_file)
    found = grid(places, rig, 0.05)
    rows, columns = np.indices(found.cells.shape)
    x = found.corner[0] + (columns + 0.5) * found.cell_m
    y = found.corner[1] + (rows + 0.5) * found.cell_m
    in_box, in_pole = (
        (np.abs(x - x_m) < length / 2) & (np.abs(y - y_m) < width / 2)
        for (x_m, y_m), (length, width, _) in (BOX_M, POLE_M)
    )
    driven = (x > 0.2) & (x < 1.8) & (np.abs(y) < 0.15)
    assert (found.cells[driven] == FREE).mean() > 0.9
    assert in_box.sum() > 50 and (found.cells[in_box] == UNKNOWN).all()
    assert in_pole.any() and (found.cells[in_pole] == UNKNOWN).all()
    # Views from which it is found, each by itself; in so short a drive its floor is also seen too seldom to be free.
    assert sum((keyframe.free_m < 0).any() for keyframe in places.keyframes.values()) >= 2
