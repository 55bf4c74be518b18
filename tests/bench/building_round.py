"""A drive around the rooms of `building` by map and path: used by `python -m tests.bench.drive building`.

Somebody drives a round of 33 m in the corridor, which makes the map. Then the robot stands up to 10 cm and 10 degrees
beside the start of that drive; it is driven on slowly until it knows where it is, and sent along a path of the saved
map: the whole round, which ends at the start of the first drive, with its heading.
"""

from __future__ import annotations

import math
import random
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.config import load_config
from omnid.core.control.heading_controller import Setpoint, wrap_angle
from omnid.core.navigation.requests import NavigationFrame, PathRequest
from omnid.simulation.demonstration import cross_track_m
from omnid.simulation.lockstep import Moment, Request, SimulatedRun, simulate
from omnid.simulation.world_file import load_world
from tests.bench.fine_robot import fine_robot
from tests.bench.route_series import (
    ASIDE_M,
    ASIDE_RAD,
    LONGEST_S,
    SEEK_MPS,
    SPACING_M,
    SPEED_MPS,
    START,
    UNRECOGNISED_S,
    WORLD,
    AskedOnceLocalised,
    Driver,
    lap,
)

Array = NDArray[np.float64]
WHOLE_M: Final = 100.0  # more than the round
SEEK_POINTS: Final = round(SEEK_MPS * UNRECOGNISED_S / SPACING_M)  # that the hand passes before the path is asked for
STAND_S: Final = 1.0  # at the end of the first drive


@dataclass(frozen=True, slots=True)
class RoundEnd:
    """The result of a round."""

    words: str
    error_m: float  # of the true position at the end from the true start of the first drive
    error_rad: float
    off_path_m: float  # largest distance of the true path from that of the path in the map
    stops: str
    pairs: int  # of both drives
    run: SimulatedRun


class FirstDrive:
    """The script of the drive that makes the map."""

    def __init__(self, line: Array) -> None:
        self._driver, self._ended_s = Driver(line), math.inf

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Drive along the line and stop."""
        if moment.place is None or not moment.controller.armed:
            if moment.place is not None:
                yield "arm"
            return
        setpoint = self._driver.setpoint(moment.T_world_base, SPEED_MPS)
        yield setpoint or Setpoint(0.0)
        if setpoint is None:
            self._ended_s = min(self._ended_s, moment.time_s)
            if moment.time_s > self._ended_s + STAND_S:
                yield "end"


def round_by_path(line: Array, path: Array) -> AskedOnceLocalised:
    """Return the script of the round; line: (N, 2) [m] in the world, for the hand; path: (N, 2) [m] in the map."""

    def asked(moment: Moment) -> Request:
        assert moment.place is not None
        near_m = np.linalg.norm(path[:SEEK_POINTS] - moment.place.T_map_rig[:2, 3], axis=1)
        return PathRequest(NavigationFrame.MAP, path[int(np.argmin(near_m)) :], 0.0)

    return AskedOnceLocalised(line, 0, asked)


def building_round(seed: int, size_px: int) -> RoundEnd:
    """Make the map and drive the round in it."""
    line, robot, rng = lap(WHOLE_M), fine_robot(size_px), random.Random(seed)
    path = np.vstack([line, START]) - START  # the map begins at the first pose, which has the heading 0
    start = (
        START[0] + rng.uniform(-ASIDE_M, ASIDE_M),
        START[1] + rng.uniform(-ASIDE_M, ASIDE_M),
        rng.uniform(-ASIDE_RAD, ASIDE_RAD),
    )
    with tempfile.TemporaryDirectory() as folder:
        config = load_config(None, [f"places.map={Path(folder) / 'building.omap'}"])
        world = replace(load_world(WORLD, seed), start=(*START, 0.0), people=())
        first = simulate(world, robot, FirstDrive(line), seconds=LONGEST_S, seed=seed, config=config)
        script = round_by_path(line, path)
        run = simulate(replace(world, start=start), robot, script, seconds=LONGEST_S, seed=seed + 1000, config=config)
    true = np.array([tick.pose for tick in run.ticks])
    stops = dict.fromkeys(line for _, line in run.lines if line.startswith("the wheels stop"))
    return RoundEnd(
        script.end or "time is over",
        math.dist(true[-1, :2], START),
        abs(wrap_angle(float(true[-1, 2]))),
        float(cross_track_m(np.vstack([line, START]), true[true_way_m(true) > 1.0, :2]).max(initial=0.0)),
        "; ".join(stops)[:120],
        len(first.stamps_ns) + len(run.stamps_ns),
        run,
    )


def true_way_m(true: Array) -> Array:
    """Return the way (N,) [m] up to each true pose (N, 3)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true[:, :2], axis=0), axis=1))])
