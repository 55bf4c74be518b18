"""A demonstration in lock-step: a simulated robot drives a square by goals, then along the path that it has driven."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.navigation.requests import GoalRequest, NavigationFrame, PathRequest
from omnid.navigation_state import NavigationState
from omnid.simulation.clearance import footprints
from omnid.simulation.lockstep import Moment, Request, SimulatedRun
from omnid.simulation.world import World

Array = NDArray[np.float64]
SIDE_M: Final = 1.5
GOALS: Final = ((SIDE_M, 0.0, 0.5 * math.pi), (SIDE_M, SIDE_M, math.pi), (0.0, SIDE_M, -0.5 * math.pi), (0.0, 0.0, 0.0))
ANSWER_S: Final = 0.5  # after a request, before its end is looked for
SPACING_M: Final = 0.1  # of the path that is repeated
PX_PER_M: Final = 90.0
MARGIN_PX: Final = 20
_WHITE, _GREY, _BLACK, _RED = (255, 255, 255), (150, 150, 150), (0, 0, 0), (0, 0, 190)  # BGR


class SquareTwice:
    """The script: goals first; then the path of the poses meanwhile. `show` takes a line at each step."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show = show
        self._steps = 0
        self._asked_s = 0.0
        self._driven: list[Array] = []
        self.repeated_s = math.inf  # when the repetition began
        self.end = ""  # in words

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Send the next request when the one before has ended."""
        if moment.odometry is None:
            return
        if not self._steps and not moment.controller.armed:
            yield "arm"
            return
        if self._steps <= len(GOALS):
            self._note(moment.T_odom_base)
        navigation = moment.navigation
        waits = navigation is None or not navigation.state.is_end or moment.time_s < self._asked_s + ANSWER_S
        if self._steps and waits:
            return
        if self._steps and navigation is not None and navigation.state is not NavigationState.REACHED:
            self.end = f"{navigation.state}: {navigation.reason}"
            yield "end"
        elif self._steps < len(GOALS):
            self._show(f"{moment.time_s:5.1f} s: drives to corner {self._steps + 1} of {len(GOALS)}")
            yield GoalRequest(NavigationFrame.ODOM, *GOALS[self._steps])
        elif self._steps == len(GOALS):
            self._show(f"{moment.time_s:5.1f} s: drives along the path that it has driven")
            self.repeated_s = moment.time_s
            yield PathRequest(NavigationFrame.ODOM, np.array([T[:2, 3] for T in self._driven]), 0.0)
        else:
            self.end = "reached"
            yield "end"
        self._steps, self._asked_s = self._steps + 1, moment.time_s

    def _note(self, T_odom_base: Array) -> None:
        """Keep a pose if it lies SPACING_M from the last one that was kept."""
        if not self._driven or np.hypot(*(T_odom_base - self._driven[-1])[:2, 3]) >= SPACING_M:
            self._driven.append(T_odom_base)


def both_paths(run: SimulatedRun, repeated_s: float) -> tuple[Array, Array]:
    """Return the true positions (N, 2), (M, 2) [m] in the world of the first drive and of the repetition."""
    first, second = ([tick.pose[:2] for tick in run.ticks if (tick.time_s >= repeated_s) == later]
                     for later in (False, True))
    return np.array(first).reshape(-1, 2), np.array(second).reshape(-1, 2)


def apart_m(first: Array, second: Array) -> Array:
    """Return the distances (M,) [m] of the positions of the second path from the nearest ones of the first."""
    return np.asarray(np.linalg.norm(second[:, None] - first[None], axis=2).min(axis=1))


def draw(world: World, first: Array, second: Array) -> NDArray[np.uint8]:
    """Return a image (H, W, 3): what stands in the world, the first path in black and the second one in red."""
    segments = footprints(world.standing, 1.2)
    low, high = segments.reshape(-1, 2).min(axis=0), segments.reshape(-1, 2).max(axis=0)
    width, height = (int(side) for side in np.ceil((high - low) * PX_PER_M) + 2 * MARGIN_PX)
    image = np.full((height, width, 3), _WHITE, np.uint8)

    def pixels(points: Array) -> NDArray[np.int32]:
        across = (points[:, 0] - low[0]) * PX_PER_M + MARGIN_PX
        down = (high[1] - points[:, 1]) * PX_PER_M + MARGIN_PX
        return np.asarray(np.rint(np.column_stack([across, down])), np.int32)

    for segment in segments:
        cv2.polylines(image, [pixels(segment)], False, _GREY, 3, cv2.LINE_AA)
    for path, color, thickness in ((first, _BLACK, 4), (second, _RED, 2)):
        if len(path):
            cv2.polylines(image, [pixels(path)], False, color, thickness, cv2.LINE_AA)
    return image


def drift_m(run: SimulatedRun) -> float:
    """Return the distance [m] of the last pose that was estimated from the true one."""
    difference = se3.inverse(run.truth_in_odom[-1]) @ run.T_odom_base[-1]
    return float(np.linalg.norm(difference[:2, 3]))
