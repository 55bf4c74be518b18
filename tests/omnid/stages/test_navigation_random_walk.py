"""A stateful property test of planner, routes and collision monitor: random events, and an oracle of what may move.

The real navigation stage drives the real control law; the oracle knows the requests, their answers and the states that
the stage reports. Without a goal that somebody asked for, or a living command of a person, the wheels only slow down.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, transform
from omnid.core.control.arming import MANUAL, OPERATOR, PLANNER, ArmRequest, TimedSetpoint
from omnid.core.control.collision_monitor import CollisionSettings, ControllerScan
from omnid.core.control.control_law import ControlLaw, ControllerPose, ControllerSettings
from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.motion_monitor import MotionSettings
from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationCommand,
    NavigationFrame,
    NavigationRequest,
    NavigationState,
    NavigationVerb,
    PathRequest,
    RouteAction,
    RouteRequest,
)
from omnid.core.navigation.settings import NavigationSettings
from omnid.core.obstacles.moving_tracker import MovingObstacle
from omnid.formats.route_file import RouteFolder
from omnid.messages import NavigationUpdate, ObstacleScan, OdometryUpdate, PlaceUpdate
from omnid.runs.files import RouteFiles
from omnid.tracking_state import MapState, TrackingState
from tests.omnid.core.navigation.driven_base import Floor, wheel_state
from tests.omnid.stages.test_navigation import fixed_map

Array = NDArray[np.float64]
TICK_S, TICKS_A_POSE = 0.02, 5
SETTINGS = ControllerSettings(arming=MANUAL, motion=MotionSettings(check=False), collision=CollisionSettings())
NAVIGATION = NavigationSettings(stuck_s=3.0, unlocalised_m=0.5, unlocalised_s=2.0)
DEPTH: Any = None  # the stage reads none
UNIT = np.eye(6) * 1e-6
AZIMUTHS = -math.pi + (np.arange(360) + 0.5) * math.tau / 360
MOVES = (NavigationState.DRIVING, NavigationState.AVOIDING, NavigationState.BLOCKED)
TINY = 1e-9


class Walk:
    """The stage, the control law, a base that obeys, and the oracle."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.rng, self.seen, self.t_s = random.Random(seed), Counter[str](), 1000.0
        self.law = ControlLaw(SETTINGS, -1)
        self.stage = fixed_map(NAVIGATION, SETTINGS.collision, np.eye(4), is_new=True)
        self.files = RouteFiles(RouteFolder(folder))
        self.pose, self.motion = np.zeros(3), (0.0, 0.0)
        self.seq = self.resets = 0
        self.state, self.map_state, self.kind = TrackingState.TRACKING, MapState.LOCALIZED, "free"
        self.operates = self.silent = False
        self.wanted = self.paused = self.armed = False  # the oracle: asked for and not ended, halted, armed
        self.published = NavigationState.IDLE
        self.posed_s = self.ringed_s = self.operated_s = -math.inf

    @property
    def now_ns(self) -> int:
        return round(self.t_s * 1e9)

    @property
    def arrival_ns(self) -> int:
        """Arrival of a message now: after the tick at this time."""
        return self.now_ns + 1

    def run(self, poses: int) -> Counter[str]:
        """Return how often what happened."""
        rng = self.rng
        for number in range(poses):
            if number % 20 == 0:
                self.state = rng.choice((TrackingState.TRACKING,) * 8 + (TrackingState.DEGRADED, TrackingState.LOST))
                self.map_state = rng.choice((MapState.LOCALIZED,) * 6 + (MapState.ODOMETRY_ONLY, MapState.LOST))
                self.kind = rng.choice(("free",) * 5 + ("box", "wall", "person", "stale"))
                self.operates, self.silent = rng.random() < 0.1, rng.random() < 0.05
                self.resets += rng.random() < 0.03
            self.send_scan()
            self.events()
            self.send_pose()
            for _ in range(TICKS_A_POSE):
                self.tick()
        return self.seen

    def events(self) -> None:
        """Let persons and programs ask for things."""
        rng = self.rng
        if rng.random() < 0.01:
            self.law.arming.stop(self.arrival_ns)
            self.wanted = self.armed = False
        if rng.random() < (0.05 if self.armed else 0.3):
            self.law.take(ArmRequest(self.arrival_ns))
        if self.operates and rng.random() < 0.8:
            setpoint = Setpoint(rng.uniform(-0.5, 0.5), None, rng.uniform(-0.5, 0.5))
            self.law.take(TimedSetpoint(self.arrival_ns, setpoint, OPERATOR))
            self.operated_s = self.t_s
        while rng.random() < (0.05 if self.wanted else 0.25):
            self.ask(self.request())

    def request(self) -> NavigationRequest:
        """Return a random request."""
        rng = self.rng
        frame = rng.choice(list(NavigationFrame))
        place = self.pose[:2] + np.array([rng.gauss(0, 1.5), rng.gauss(0, 1.5)])
        route = rng.choice(("a", "a", "a", "b", "missing"))
        return rng.choice(
            (
                GoalRequest(frame, *place.tolist(), rng.choice((None, rng.uniform(-3, 3)))),
                GoalRequest(frame, *(self.pose[:2] + rng.choice((0.0, 1e3))).tolist()),
                PathRequest(frame, np.vstack([self.pose[:2], place, place + rng.uniform(-1, 1)])),
                NavigationVerb.CANCEL,
                NavigationVerb.PAUSE,
                NavigationVerb.PAUSE,
                NavigationVerb.RESUME,
                RouteRequest(RouteAction.TEACH, route),
                RouteRequest(RouteAction.FINISH),
                RouteRequest(RouteAction.REPEAT, route, rng.random() < 0.5, rng.randint(1, 3)),
                RouteRequest(RouteAction.STOP),
            )
        )

    def ask(self, request: NavigationRequest) -> None:
        """Send a request, and take its answer into the oracle."""
        teaching = self.seen_teaching
        self.stage.process(wheel_state(self.law))
        update = self.stage.process(NavigationCommand(request, self.now_ns, self.now_ns))
        assert update is not None
        written = self.files.write(update)
        accepted = written[0].done if written else update.answer is not None and not update.answer.refusal
        word = (
            type(request).__name__
            if not isinstance(request, NavigationVerb | RouteRequest)
            else str(request if isinstance(request, NavigationVerb) else request.action)
        )
        self.seen[f"{word} {'accepted' if accepted else 'refused'}"] += 1
        match request:
            case GoalRequest() | PathRequest() | RouteRequest(RouteAction.REPEAT) if accepted:
                self.wanted, self.paused = True, False
            case NavigationVerb.CANCEL:
                self.wanted = False
            case RouteRequest(RouteAction.STOP) if not teaching:
                self.wanted = False
            case NavigationVerb.PAUSE if accepted:
                self.paused = True
            case NavigationVerb.RESUME if accepted:
                self.paused = False
        self.take(update)

    def take(self, update: NavigationUpdate | None) -> None:
        """Pass a setpoint on to the control law."""
        if update is None:
            return
        self.published, self.seen_teaching = update.state, update.teaching
        self.seen[str(update.state)] += 1
        self.wanted = self.wanted and not update.state.is_end
        if update.setpoint is not None:
            self.law.take(TimedSetpoint(self.arrival_ns, update.setpoint, PLANNER))

    seen_teaching = ""

    def send_pose(self) -> None:
        """Send a pose and its place to both; none while the images are away."""
        if self.silent:
            return
        self.seq += 1
        T = transform(self.pose)
        velocity = np.array([self.motion[0], 0, 0, 0, 0, self.motion[1]])
        self.law.take(
            ControllerPose(
                self.now_ns, float(self.pose[2]), self.motion[1], self.state, self.motion[0], resets=self.resets
            )
        )
        self.stage.process(PlaceUpdate(self.seq, self.now_ns, np.eye(4), T, UNIT, self.map_state, 3, T))
        self.stage.process(wheel_state(self.law))
        self.posed_s = self.t_s if self.state is not TrackingState.LOST else -math.inf
        self.take(
            self.stage.process(
                OdometryUpdate(self.seq, self.now_ns, T, UNIT, velocity, UNIT, self.state, self.resets, 100, 100, DEPTH)
            )
        )

    def send_scan(self) -> None:
        """Send what stands around the base, in a stale phase nothing."""
        if self.kind == "stale":
            return
        ranges, moving = np.full(360, np.inf, np.float32), ()
        ahead = np.abs(AZIMUTHS) < {"box": 0.25, "wall": 1.5, "person": 0.15}.get(self.kind, 0.0)
        ranges[ahead] = (0.9 / np.cos(AZIMUTHS[ahead] * 0.9)).clip(0, 3)
        if self.kind == "person":
            to = composed(self.pose[None], np.array([1.0, 0.0, 0.0]))[0]
            moving = (
                MovingObstacle(
                    *to[:2].tolist(), self.rng.uniform(-1, 1), self.rng.uniform(-1, 1), np.eye(4) * 0.01, 0.2
                ),
            )
        self.law.take(ControllerScan(self.now_ns, tuple(ranges.tolist())))
        self.ringed_s = self.t_s
        grid, sigma_m = Floor(all_seen=True).grid(self.pose, ranges), np.full(360, 0.01, np.float32)
        found = ranges, sigma_m, ranges, transform(self.pose), moving
        self.stage.process(ObstacleScan(self.seq, self.now_ns, *found, grid=grid))

    def tick(self) -> None:
        """Tick, and hold the motion against the oracle."""
        self.t_s += TICK_S
        motion = self.law.step(self.now_ns, TICK_S).motion
        armed = self.law.arming.armed
        if self.armed and not armed:
            self.paused = True  # by a fault, until a person resumes
        self.armed = armed
        before, now = self.motion, (motion.velocity_mps, motion.yaw_rate_radps)
        goal = self.wanted and not self.paused and self.published in MOVES
        person = self.t_s - self.operated_s <= SETTINGS.deadlines.command_s
        sees = (
            self.t_s - self.posed_s <= SETTINGS.deadlines.pose_s
            and self.t_s - self.ringed_s <= SETTINGS.collision.stale_s
        )
        if not (armed and sees and (goal or person)):
            for was, be in zip(before, now, strict=True):
                assert abs(be) <= abs(was) + TINY and was * be >= 0, (before, now, self.published, self.law.reason)
            self.seen["stands" if now == (0.0, 0.0) else "slows down"] += 1
        else:
            self.seen["moves for a goal" if goal and now != (0.0, 0.0) else "may move"] += 1
        self.motion = now
        self.pose = composed(self.pose[None], np.array([now[0] * TICK_S, 0.0, now[1] * TICK_S]))[0]


def test_nothing_moves_without_a_goal_or_a_persons_command(tmp_path: Path) -> None:
    seen = Walk(1, tmp_path).run(750)
    assert seen["moves for a goal"] > 150 and seen["slows down"] > 10, seen
