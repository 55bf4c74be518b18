"""A demonstration in lock-step: a simulated robot is taught a route by driving it, and repeats it in its map."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import Config
from omnid.core.navigation.requests import NavigationFrame, PathRequest, RouteAction, RouteRequest
from omnid.errors import OmnidError
from omnid.formats.plan import Lines, draw_plan, image_of
from omnid.navigation_state import NavigationState
from omnid.simulation.lockstep import Moment, Request, simulate
from omnid.simulation.robot import make_robot
from omnid.simulation.world import cross_track_m, load_world
from omnid.tracking_state import MapState

Array = NDArray[np.float64]
ROUTE: Final = "demo"
DRIVE_S: Final = 90.0  # Longest drive in simulated time.
STRAIGHT_M, RADIUS_M = 0.8, 0.7  # The oval that is taught: 6 m.


def oval() -> Array:
    """Return the positions (N, 2) [m] in odom of a round drive that ends where it begins."""
    turns = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 15)
    right = np.column_stack([STRAIGHT_M + RADIUS_M * np.cos(turns), RADIUS_M + RADIUS_M * np.sin(turns)])
    left = np.array([STRAIGHT_M, 2 * RADIUS_M]) - right
    return np.vstack([(0.0, 0.0), right, left])


@dataclass(slots=True)
class TeachAndRepeat:
    """A script: an operator drives an oval while the route is taught, then it is repeated. `show` takes lines."""

    show: Callable[[str], None]
    repeated_s: float = math.inf  # when the repetition began
    end: str = ""  # in words

    def requests(self) -> Generator[list[Request], Moment, None]:
        """Yield the requests of each moment, which is sent."""
        # 1. Arm the wheels.
        moment = yield []
        while moment.place is None or not moment.controller.armed:
            moment = yield [] if moment.place is None else ["arm"]
        # 2. Teach the route along an oval; a route of that name is from an earlier demonstration.
        self.show(f"{moment.time_s:5.1f} s: the robot is taught a route: it is driven along an oval")
        teach = RouteRequest(RouteAction.TEACH, ROUTE, replace=True)
        moment = yield from self._ended([teach, PathRequest(NavigationFrame.ODOM, oval(), 0.0)])
        # 3. Repeat it, when its start is recognised.
        if self.end == NavigationState.REACHED:
            while moment.place is None or moment.place.state is not MapState.LOCALIZED:
                moment = yield []
            self.show(f"{moment.time_s:5.1f} s: the robot repeats the route in the map that it has made")
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


def demonstrate(image: Path, config: Config, seed: int, show: Callable[[str], None]) -> tuple[bool, list[str]]:
    """Teach a robot an oval, have it repeat that, and draw it in the style of plan.png.

    Return whether it reached the end, and lines with its errors against the truth. show: takes lines while it drives.
    Raises OmnidError where the image cannot be written.
    """
    # 1. The drive, and the true positions (N, 2) [m] of both rounds.
    world, script = load_world("room", seed), TeachAndRepeat(show)
    requests = script.requests()
    next(requests)
    run = simulate(world, make_robot(), requests.send, seconds=DRIVE_S, seed=seed, config=config)
    first, second = (
        np.array([tick.pose[:2] for tick in run.ticks if (tick.time_s >= script.repeated_s) == later]).reshape(-1, 2)
        for later in (False, True)
    )
    # 2. The image: the world, and both rounds.
    lines = [
        Lines(list(world.obstacles(1.2)), "silver", 2, "walls and boxes"),
        Lines([first], "black", 4, "taught path"),
        Lines([second], "red", 1.5, "repeated path"),
    ]
    drawn = image_of(draw_plan(np.zeros((0, 2)), np.zeros(0, np.float32), lines, first))
    if not cv2.imwrite(str(image), drawn):
        raise OmnidError(f"{image}: cannot be written; name another folder by --output")
    # 3. The errors.
    end = script.end or f"not reached within {DRIVE_S:g} s"
    drift_m = np.linalg.norm(se3.apply(se3.inverse(run.truth_in_odom[-1]), run.T_odom_base[-1, :3, 3][None])[0, :2])
    report = [f"end       {end}, contacts with obstacles: {len(run.contacts)}"]
    report.append(f"pose      {100 * drift_m:.1f} cm off at the end")
    if len(second):
        off_cm = 100 * cross_track_m(first, second)
        report.append(
            f"repeated  {np.percentile(off_cm, 95):.1f} cm off the taught path (95 %), {off_cm.max():.1f} at most"
        )
    return script.end == NavigationState.REACHED, report
