"""A base that the real control law drives on the floor: inertia, unequal wheels, noise, delayed poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, relative
from omnid.core.control.arming import AUTOMATIC, PLANNER, TimedSetpoint
from omnid.core.control.control_law import ControlLaw, ControllerPose, ControllerSettings, ControllerState
from omnid.core.control.motion_monitor import MotionSettings
from omnid.core.navigation.navigator import Navigation, Navigator
from omnid.core.navigation.situation import MapPosition, Situation
from omnid.core.obstacles.grid import CELL_M, SIDE, FloorGrid
from omnid.tracking_state import MapState, TrackingState

Array = NDArray[np.float64]
TICK_S, TICKS_A_POSE = 0.02, 5
TRACK_M = 0.4
LAG_S = 0.1
AGE_S = 0.08  # of a pose when it is known
OWN_M = 0.25  # the base stands on floor


ARMED = ControllerState(reason="", armed=True, disarmed_by="")


def wheel_state(law: ControlLaw) -> ControllerState:
    """Return the state of the wheels, as the controller makes it of its law."""
    arming, current = law.arming, law.commands.current
    source = "" if law.reason or current is None else current.source
    return ControllerState(
        law.reason,
        arming.armed,
        arming.reason,
        arming.needs_request,
        source=source,
        obstacle=law.collision.reason,
        blocked=law.collision.holds,
    )


class Floor:
    """The grid of the obstacles as scans fill it: cells of odom are free as far as a scan says, and stay known."""

    def __init__(self, *, all_seen: bool = False) -> None:
        """all_seen: what is no obstacle counts as free, everywhere about the base."""
        self._side, self._all_seen = (SIDE if all_seen else 2 * SIDE), all_seen
        self._states = np.full((self._side, self._side), 0.0 if all_seen else np.nan, np.float32)

    def grid(self, pose: Array, ranges_m: Array, free_m: Array | None = None) -> FloorGrid:
        """Return the grid after a scan at a pose (3,)."""
        middle = np.round(pose[:2] / CELL_M) if self._all_seen else np.zeros(2)
        corner_m = CELL_M * (middle - self._side // 2)
        if not self._all_seen:
            seen_m = np.where(np.isfinite(ranges_m), ranges_m, 4.0) if free_m is None else free_m
            seen_m = np.maximum(seen_m, OWN_M)
            # Only the cells about the base: a grid of all of them takes most of the time of a drive.
            reach = math.ceil(float(seen_m.max()) / CELL_M) + 1
            first = np.maximum(np.floor((pose[:2] - corner_m) / CELL_M).astype(int) - reach, 0)
            near = self._states[first[1] : first[1] + 2 * reach, first[0] : first[0] + 2 * reach]
            middles = np.indices(near.shape) + 0.5 + first[::-1, None, None]
            y, x = CELL_M * middles + (corner_m - pose[:2])[::-1, None, None]
            sector = np.floor((np.arctan2(y, x) - (pose[2] - math.pi)) * (360 / math.tau)).astype(int) % 360
            near[np.hypot(x, y) <= seen_m[sector]] = 0.0
        at = np.flatnonzero(np.isfinite(ranges_m))
        angles = pose[2] - math.pi + (at + 0.5) * (math.tau / 360)
        points = pose[:2] + ranges_m[at, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        grid = FloorGrid(corner_m, self._states.copy())
        rows, columns = grid.at(points)
        inside = (np.minimum(rows, columns) >= 0) & (np.maximum(rows, columns) < self._side)
        grid.occupied[rows[inside], columns[inside]] = 1.0
        return grid


class Sample(NamedTuple):
    """The base at one pose."""

    t_s: float
    pose: Array  # true, in odom
    speed_mps: float
    yaw_rate_radps: float
    navigation: Navigation


class DrivenBase:
    """Poses in, commands out; odom is the true frame, and the map may lie elsewhere."""

    has_scan = False  # else nothing looks for obstacles

    def __init__(
        self,
        navigator: Navigator,
        seed: int,
        *,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        T_map_odom: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.navigator = navigator
        self.rng = np.random.default_rng(seed)
        self.pose = np.array(start)
        self.v = self.w = self.t_s = 0.0
        self.samples: list[Sample] = []
        self.localised = True
        self.state = TrackingState.TRACKING
        self.resets = 0
        self.slip = 1.0  # share of the commanded motion that happens
        self.T_map_odom = np.array(T_map_odom)
        settings = ControllerSettings(arming=AUTOMATIC, motion=MotionSettings(check=False))
        self.law = ControlLaw(settings if self.has_scan else settings.without_obstacles, -1)
        self.law.take(ControllerPose(0, float(self.pose[2]), 0.0, "tracking", 0.0))
        self.law.step(0, 0.0)
        self._gain = 1.0 + 0.02 * self.rng.standard_normal(2)
        self._ticks = 0
        self._coming: list[tuple[float, Situation]] = []

    @property
    def wheels(self) -> ControllerState:
        return wheel_state(self.law)

    def seen(self) -> Situation:
        """Return the pose as it is estimated now."""
        noisy = self.pose + self.rng.normal(0, [0.003, 0.003, 0.002])
        state = MapState.LOCALIZED if self.localised else MapState.ODOMETRY_ONLY
        return Situation(
            round(self.t_s * 1e9),
            noisy,
            self.v + self.rng.normal(0, 0.01),
            self.w + self.rng.normal(0, 0.01),
            self.state,
            self.resets,
            self.wheels,
            MapPosition(self.T_map_odom, state, 0.02, round(self.t_s * 1e9)),
        )

    def tick(self) -> Navigation | None:
        """Advance by TICK_S; return the answer of the navigation where a pose has come."""
        answer = None
        if self._ticks % TICKS_A_POSE == 0:
            self._coming.append((self.t_s + AGE_S, self.seen()))
        while self._coming and self._coming[0][0] <= self.t_s:
            _, now = self._coming.pop(0)
            answer = self._at_pose(now)
        now_ns = round(self.t_s * 1e9)
        motion = self.law.step(now_ns, TICK_S).motion
        left, right = (
            gain * (motion.velocity_mps + side * motion.yaw_rate_radps * TRACK_M / 2)
            for gain, side in zip(self._gain, (-1, 1), strict=True)
        )
        self.v += (0.5 * (left + right) * self.slip - self.v) * TICK_S / LAG_S
        self.w += ((right - left) / TRACK_M * self.slip - self.w) * TICK_S / LAG_S
        v = self.v * (1 + 0.03 * self.rng.standard_normal())
        self.pose = composed(self.pose[None], np.array([v * TICK_S, 0.0, self.w * TICK_S]))[0]
        self.t_s += TICK_S
        self._ticks += 1
        return answer

    def _at_pose(self, now: Situation) -> Navigation:
        answer = self.navigator.step(now._replace(wheels=self.wheels))
        self.law.take(
            ControllerPose(
                now.stamp_ns, float(now.pose[2]), now.yaw_rate_radps, now.state, now.speed_mps, resets=now.resets
            )
        )
        if answer.setpoint is not None:
            self.law.take(TimedSetpoint(round(self.t_s * 1e9), answer.setpoint, PLANNER))
        self.samples.append(Sample(self.t_s, self.pose.copy(), self.v, self.w, answer))
        return answer

    def run(
        self,
        seconds: float,
        until: Callable[[Navigation], bool] = lambda answer: answer.state.is_end,
        rest_s: float = 1.0,
    ) -> Navigation:
        """Drive until the navigation ends, then rest_s on; return the last answer. AssertionError after the time."""
        end_s = self.t_s + seconds
        while self.t_s < end_s:
            answer = self.tick()
            if answer is not None and until(answer):
                for _ in range(round(rest_s / TICK_S)):
                    self.tick()
                return answer
        raise AssertionError(f"no end within {seconds} s: {self.samples[-1]}")

    def error(self, goal: tuple[float, float, float]) -> tuple[float, float]:
        """Return the true distance and heading error to a goal in odom, m and rad."""
        missing = relative(self.pose, np.array(goal))
        return math.hypot(missing[0], missing[1]), abs(math.remainder(missing[2], math.tau))
