"""A demonstration in lock-step: a simulated robot is taught a route by driving it, and repeats it in its map."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.range_scan import azimuths
from omnid.core.navigation.requests import NavigationFrame, PathRequest, RouteAction, RouteRequest
from omnid.formats.plan import BLACK, LIGHT_GREY, RED, Lines, draw_ends, draw_plan, sheet_of, with_legend
from omnid.navigation_state import NavigationState
from omnid.simulation.lockstep import Moment, Request, SimulatedRun
from omnid.simulation.world import World, distances_m
from omnid.tracking_state import MapState

Array = NDArray[np.float64]
ROUTE: Final = "demo"
STRAIGHT_M, RADIUS_M = 0.8, 0.7  # The oval that is taught: 6 m.
ARC_STEPS: Final = 15
LEGEND: Final = (  # colour (BGR) and width [px]
    ("taught path", BLACK, 5),
    ("repeated path", RED, 2),
    ("seen obstacles", (60, 60, 60), 9),  # a cell in which much was seen
    ("walls and boxes", LIGHT_GREY, 3),
)


def oval() -> Array:
    """Return the positions (N, 2) [m] in odom of a round drive that ends where it begins."""
    turns = np.linspace(-0.5 * math.pi, 0.5 * math.pi, ARC_STEPS)
    right = np.column_stack([STRAIGHT_M + RADIUS_M * np.cos(turns), RADIUS_M + RADIUS_M * np.sin(turns)])
    left = np.array([STRAIGHT_M, 2 * RADIUS_M]) - right
    return np.vstack([(0.0, 0.0), right, left])


class TeachAndRepeat:
    """The script: an operator drives an oval while the route is taught, then it is repeated. `show` takes lines."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show = show
        self.repeated_s = math.inf  # when the repetition began
        self.end = ""  # in words
        self._steps = self._drive()
        next(self._steps)

    def __call__(self, moment: Moment) -> Iterable[Request]:
        """Return the next requests, once what was asked for has ended."""
        return self._steps.send(moment)

    def _drive(self) -> Generator[list[Request], Moment, None]:
        """Yield the requests of each moment."""
        # 1. Arm the wheels.
        moment = yield []
        while moment.place is None or not moment.controller.armed:
            moment = yield [] if moment.place is None else ["arm"]
        # 2. Teach the route along an oval; a route of that name is from an earlier demonstration.
        self._show(f"{moment.time_s:5.1f} s: is taught the route: it is driven along an oval")
        teach = RouteRequest(RouteAction.TEACH, ROUTE, replace=True)
        moment = yield from self._ended([teach, PathRequest(NavigationFrame.ODOM, oval(), 0.0)])
        # 3. Repeat it, when its start is recognised.
        if self.end == NavigationState.REACHED:
            while moment.place is None or moment.place.state is not MapState.LOCALIZED:
                moment = yield []
            self._show(f"{moment.time_s:5.1f} s: repeats the route in the map that it has made")
            self.repeated_s, self.end = moment.time_s, ""
            yield from self._ended([RouteRequest(RouteAction.FINISH), RouteRequest(RouteAction.REPEAT, ROUTE)])
        while True:
            yield ["end"]

    def _ended(self, requests: list[Request]) -> Generator[list[Request], Moment, Moment]:
        """Yield requests, and nothing until the drive has ended; keep how. Return the moment."""
        moment = yield requests
        has_begun = False
        while True:
            if (update := moment.navigation) is not None:
                has_begun = has_begun or not update.state.is_end
                if update.answer is not None and update.answer.refusal:
                    self.end = f"refused: {update.answer.refusal}"
                    return moment
                if has_begun and update.state.is_end:
                    is_there = update.state is NavigationState.REACHED
                    self.end = update.state if is_there else f"{update.state}: {update.reason}"
                    return moment
            moment = yield []


def both_paths(run: SimulatedRun, repeated_s: float) -> tuple[Array, Array]:
    """Return the true positions (N, 2), (M, 2) [m] in the world of the first drive and of the repetition."""
    first, second = (
        [tick.pose[:2] for tick in run.ticks if (tick.time_s >= repeated_s) == later] for later in (False, True)
    )
    return np.array(first).reshape(-1, 2), np.array(second).reshape(-1, 2)


def cross_track_m(first: Array, second: Array) -> Array:
    """Return the distances (M,) [m] of positions (M, 2) from the line through others (N, 2)."""
    return distances_m(np.stack([first, np.vstack([first[1:], first[-1:]])], axis=1), second)


def seen_obstacles(run: SimulatedRun) -> Array:
    """Return the obstacles (N, 2) [m] of all scans, where the robot believes them, in the world."""
    directions, found = np.column_stack([np.cos(azimuths()), np.sin(azimuths()), np.zeros(len(azimuths()))]), []
    for scan in run.scans:
        seen = np.isfinite(scan.ranges_m)
        at = scan.ranges_m[seen, None] * directions[seen]
        found.append(se3.apply(run.T_world_base[0] @ scan.T_odom_base, at)[:, :2])
    return np.vstack([np.zeros((0, 2)), *found])


def draw(world: World, obstacles: Array, first: Array, second: Array) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) in the style of plan.png: the world, what the robot has seen of it, both paths.

    All are positions (N, 2) [m] in the world. A cell is the darker, the more often something was seen there.
    """
    segments = world.obstacles(1.2)
    sheet = sheet_of(obstacles, segments.reshape(-1, 2))
    taught, repeated, _, walls = LEGEND
    lines = [Lines(list(segments), *walls[1:]), Lines([first], *taught[1:]), Lines([second], *repeated[1:])]
    image = draw_plan(sheet, obstacles, np.ones(len(obstacles), np.float32), lines)
    if len(first):
        draw_ends(image, sheet, first[0])
    return with_legend(image, LEGEND)


def drift_m(run: SimulatedRun) -> float:
    """Return the distance [m] of the last pose that was estimated from the true one."""
    difference = se3.inverse(run.truth_in_odom[-1]) @ run.T_odom_base[-1]
    return float(np.linalg.norm(difference[:2, 3]))
