"""Free floor and goals by the size of the images: `python -m tests.benchmark.obstacle_sizes --sizes 256 320`.

The simulated robot of lock-step drives to two goals in the world "room", ahead and back, with the default settings: at
the end of the floor that was seen it stops. A size that shows too little of the floor does not reach them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Final

import numpy as np

from omnid.config import load_config
from omnid.core.navigation.requests import GoalRequest, NavigationFrame
from omnid.navigation_state import NavigationState
from omnid.simulation.lockstep import Moment, Request, SimulatedRun, simulate
from omnid.simulation.robot import make_robot
from omnid.simulation.world_file import load_world
from tests.benchmark.results import Column, ResultTable

SECONDS: Final = 40.0
GOALS: Final = (GoalRequest(NavigationFrame.ODOM, 0.8, 0.0), GoalRequest(NavigationFrame.ODOM, 0.0, 0.0, 0.0))
AT_REST: Final = slice(5, 10)  # rings before the robot drives
DRIVES_S: Final = 1.2


class Errand:
    """Sends the goals one after the other, and ends after the last."""

    def __init__(self) -> None:
        self.reached = 0
        self._asked = False

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Return the requests of a moment, as a drive of the simulator does."""
        if moment.time_s < DRIVES_S or moment.odometry is None:
            return
        if not moment.controller.armed:
            yield "arm"
        elif not self._asked:
            self._asked = True
            yield GOALS[self.reached]
        elif moment.navigation is not None and moment.navigation.state is NavigationState.REACHED:
            self.reached += 1
            if self.reached == len(GOALS):
                yield "end"
            else:
                yield GOALS[self.reached]


def free_m(run: SimulatedRun, rings: slice) -> float:
    """Return the median of the way that is free, over directions and rings [m]."""
    return float(np.median([ring.free_m for ring in run.rings[rings]]))


def main() -> None:
    """Print a row for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=(256, 320, 384, 512), metavar="PX")
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 2), metavar=("FIRST", "LAST"))
    arguments = parser.parse_args()
    columns = (
        Column("images", "px"),
        Column("seed"),
        Column("free floor at rest", "m", 2),
        Column("free floor at the end", "m", 2),
        Column("goals reached"),
        Column("goals"),
        Column("stops"),
        Column("contacts"),
        Column("time", "s", 1),
    )
    table = ResultTable("obstacle_sizes", "obstacles", "Goals by the size of the images", columns)
    config = load_config(None, ["places.enabled=false"])
    for size in arguments.sizes:
        for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
            errand = Errand()
            run = simulate(
                load_world("room", seed), make_robot(size), errand, seconds=SECONDS, seed=seed, config=config
            )
            stops = sum("obstacle" in text or "way ahead" in text for _, text in run.lines)
            table.add(
                size,
                seed,
                free_m(run, AT_REST),
                free_m(run, slice(-5, None)),
                errand.reached,
                len(GOALS),
                stops,
                len(run.contacts),
                run.ticks[-1].time_s,
                seed=("room", seed),
            )


if __name__ == "__main__":
    main()
