"""A demonstration in lock-step: a simulated robot is taught a route by driving it, and repeats it in its map."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.range_scan import azimuths
from omnid.core.navigation.requests import NavigationFrame, PathRequest, RouteAction, RouteRequest
from omnid.formats.plan import BLACK, LIGHT_GREY, RED, Lines, Sheet, draw_ends, draw_plan, with_legend
from omnid.messages import NavigationUpdate, ObstacleScan, PlaceUpdate
from omnid.navigation_state import NavigationState
from omnid.simulation.lockstep import Moment, Request, SimulatedRun
from omnid.simulation.world import World, distances_m
from omnid.tracking_state import MapState

Array = NDArray[np.float64]
ROUTE: Final = "demo"
STRAIGHT_M, RADIUS_M = 0.8, 0.7  # The oval that is taught: 6 m.
ARC_STEPS: Final = 15
ANSWER_S: Final = 0.5  # Time after a request before its end is awaited.
RECOGNISED_S: Final = 5.0  # Within this time after the first drive the robot must have recognised the start.
PX_PER_M: Final = 90.0
BORDER_M: Final = 0.25  # around the world
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
        self._taught = False
        self._asked_s, self._driven_s = 0.0, math.inf
        self.repeated_s = math.inf  # when the repetition began
        self.end = ""  # in words

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Send the next requests when what was asked for has ended."""
        if moment.place is None:
            return
        if not self._asked_s:
            yield from self._teach(moment)
        elif moment.navigation is not None and moment.time_s >= self._asked_s + ANSWER_S:
            yield from self._continue(moment, moment.place, moment.navigation)

    def _teach(self, moment: Moment) -> Iterator[Request]:
        """Arm the wheels, then teach the route along an oval."""
        if not moment.controller.armed:
            yield "arm"
            return
        self._begin(moment, "is taught the route: it is driven along an oval")
        yield RouteRequest(RouteAction.TEACH, ROUTE, replace=True)  # that of an earlier demonstration
        yield PathRequest(NavigationFrame.ODOM, oval(), 0.0)

    def _continue(self, moment: Moment, place: PlaceUpdate, navigation: NavigationUpdate) -> Iterator[Request]:
        """At the end of the oval repeat the route, and at that of the repetition end the run."""
        refusal = "" if navigation.answer is None else navigation.answer.refusal
        if refusal or (navigation.state.is_end and navigation.state is not NavigationState.REACHED):
            self.end = f"refused: {refusal}" if refusal else f"{navigation.state}: {navigation.reason}"
            yield "end"
        elif navigation.state is NavigationState.REACHED and not self._taught:
            self._driven_s = min(self._driven_s, moment.time_s)
            if place.state is not MapState.LOCALIZED:
                if moment.time_s > self._driven_s + RECOGNISED_S:
                    self.end = "the start of the route was not recognised"
                    yield "end"
                return
            self._taught = True
            self._begin(moment, "repeats the route in the map that it has made")
            self.repeated_s = moment.time_s
            yield RouteRequest(RouteAction.FINISH)
            yield RouteRequest(RouteAction.REPEAT, ROUTE)
        elif navigation.state is NavigationState.REACHED:
            self.end = NavigationState.REACHED
            yield "end"

    def _begin(self, moment: Moment, text: str) -> None:
        self._asked_s = moment.time_s
        self._show(f"{moment.time_s:5.1f} s: {text}")


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
    if not len(run.T_world_base):
        return np.zeros((0, 2))
    directions = np.column_stack([np.cos(azimuths()), np.sin(azimuths()), np.zeros(len(azimuths()))])

    def places(scan: ObstacleScan) -> Array:
        seen = np.isfinite(scan.ranges_m)
        at = scan.ranges_m[seen, None] * directions[seen]
        return np.asarray(se3.apply(run.T_world_base[0] @ scan.T_odom_base, at)[:, :2])

    return np.vstack([np.zeros((0, 2)), *(places(scan) for scan in run.scans)])


def draw(world: World, obstacles: Array, first: Array, second: Array) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) in the style of plan.png: the world, what the robot has seen of it, both paths.

    All are positions (N, 2) [m] in the world. A cell is the darker, the more often something was seen there.
    """
    segments = world.obstacles(1.2)
    corners = segments.reshape(-1, 2)
    sheet = Sheet(corners.min(axis=0) - BORDER_M, corners.max(axis=0) + BORDER_M, PX_PER_M)
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
