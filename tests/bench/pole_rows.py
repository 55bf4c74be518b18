"""Rooms with rows of plain poles on either side of a way, and an operator who drives along it and back.

A plain pole has no texture along a column of a panorama: only the floor that it hides shows it.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from typing import Final

from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.simulation.lockstep import Moment, Request

WAY_M: Final = 8.0  # length of the way
SPACING_M: Final = 0.9  # between the poles of a row, along the way
SIDES_M: Final = (0.03, 0.1)
PASSED_M: Final = (0.3, 1.5)  # from the outline of the base to a pole
FLOORS: Final = ("tiles", "granite", "brick")
SPEED_MPS: Final = 0.5
TURNED_RAD: Final = 0.2  # a heading so near the wanted one is reached


def room_text(rng: random.Random, radius_m: float) -> str:
    """Return a world file with the poles beside the x axis; radius_m: of the base that drives along it."""
    low, high = (-1.5, -2.6), (WAY_M + 1.5, 2.6)
    lines = ["schema = 1", "start = [0.0, 0.0, 0.0]", "[space]", f"low = {list(low)}", f"high = {list(high)}"]
    lines += [f'floor = "{rng.choice(FLOORS)}"']
    corners = [[low[0], low[1]], [low[0], high[1]], [high[0], high[1]], [high[0], low[1]]]
    for first, last in zip(corners, corners[1:] + corners[:1], strict=True):
        texture = rng.choice(("brick", "granite", "plaster"))
        lines += ["[[wall]]", f"points = {[first, last]}", f'texture = "{texture}"', "posters_per_m = 0.6"]
    for side in (-1, 1):
        for n in range(int(WAY_M / SPACING_M)):
            wide_m = rng.uniform(*SIDES_M)
            x_m = SPACING_M * (n + 0.5 + 0.25 * side) + rng.uniform(-0.15, 0.15) + 0.3
            y_m = side * (radius_m + wide_m / 2 + rng.uniform(*PASSED_M))
            lines += ["[[box]]", f"at = [{x_m}, {y_m}]", f"yaw_deg = {rng.uniform(-45, 45)}"]
            lines += [f"size_m = [{wide_m}, {wide_m}, 1.8]", 'texture = "white"']
    return "\n".join(lines) + "\n"


class ThereAndBack:
    """Holds the stick ahead along x, turns at the end of the way, and holds it ahead again until the start."""

    def __init__(self) -> None:
        self._heading_rad = 0.0

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Yield the operator's requests at a moment."""
        if moment.odometry is not None and not moment.controller.armed and moment.time_s < 2.0:
            yield "arm"
        T = moment.T_odom_base
        if T[0, 3] > WAY_M:
            self._heading_rad = math.pi
        is_back = self._heading_rad > 0 and T[0, 3] < 0
        off_rad = abs(wrap_angle(self._heading_rad - math.atan2(T[1, 0], T[0, 0])))
        yield Setpoint(0.0 if is_back or off_rad > TURNED_RAD else SPEED_MPS, heading_rad=self._heading_rad)
