"""A drive in lock-step: the daemon's stages inline, the real controller, and a robot whose wheels change what it sees.

Time is simulated. The same world, robot, drive, seed and configuration give the same bytes on any host. Between two
pairs of images the controller ticks. A pose reaches it robot.pose_delay_s after its images were exposed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.frame import Frame
from drivers.motion import MotionSample
from omnid.config import Config
from omnid.core.control.arming import PLANNER, ArmRequest, TimedSetpoint
from omnid.core.control.control_law import ControllerState
from omnid.core.control.heading_controller import Setpoint
from omnid.core.nanoseconds import NS_PER_S
from omnid.core.navigation.requests import NavigationCommand, NavigationRequest
from omnid.engine.graph import Graph, no_op
from omnid.messages import NavigationUpdate, ObstacleScan, OdometryUpdate, PlaceUpdate
from omnid.runs.files import RunPlaces
from omnid.runs.wiring import Inputs, run_to_end, wire
from omnid.simulation.robot import SimulatedRobot, Tick, Vehicle
from omnid.simulation.world import World
from omnid.sinks.drive import NAVIGATION_SENDER, controller_pose
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry
from omnid.stages.obstacles import controller_scan
from omnid.transport.topics import MAX_OPEN

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Moment:
    """State of a drive when a pair of images is due. Scripts that watch use the true pose, planners must not."""

    time_s: float  # since the start of the drive
    T_world_base: Array  # (4, 4) true pose
    controller: ControllerState
    odometry: OdometryUpdate | None  # newest pose of odometry
    T_odom_base: Array  # (4, 4) the same pose as a transform; the identity before the first one
    navigation: NavigationUpdate | None  # newest update of the navigation
    place: PlaceUpdate | None  # newest pose in the map


# A setpoint of the operator, a request to arm, the end of the run, or a request to the navigation.
Request: TypeAlias = Setpoint | Literal["arm", "end"] | NavigationRequest
# Sends requests as a person or a program would; called once for every pair of images.
Drive: TypeAlias = Callable[[Moment], Iterable[Request]]


class EstimatedPose(NamedTuple):
    """A pose of odometry, with the truth."""

    stamp_ns: int
    T_world_base: Array  # (4, 4) true
    T_odom_base: Array  # (4, 4) estimated
    state: str  # of the tracking
    is_slipping: bool  # the daemon reports that the wheels slip


@dataclass(slots=True)
class SimulatedRun:
    """The truth and the estimates of a drive; odom is the frame of the base at the first pair."""

    T_base_rig: Array  # (4, 4)
    poses: list[EstimatedPose] = field(default_factory=list)
    ticks: list[Tick] = field(default_factory=list)
    lines: list[tuple[float, str]] = field(default_factory=list)  # time [s] and text: what the controller reported
    scans: list[ObstacleScan] = field(default_factory=list)
    navigation: list[NavigationUpdate] = field(default_factory=list)
    places: list[PlaceUpdate] = field(default_factory=list)

    @property
    def T_world_base(self) -> Array:
        """The true poses (N, 4, 4)."""
        return np.array([pose.T_world_base for pose in self.poses]).reshape(-1, 4, 4)

    @property
    def T_odom_base(self) -> Array:
        """The estimated poses (N, 4, 4)."""
        return np.array([pose.T_odom_base for pose in self.poses]).reshape(-1, 4, 4)

    @property
    def truth_in_odom(self) -> Array:
        """The true poses (N, 4, 4) in odom."""
        return np.asarray(se3.inverse(self.T_world_base[:1]) @ self.T_world_base)

    @property
    def contacts(self) -> list[Tick]:
        """The first tick of each contact with an obstacle."""
        touches = np.array([False, *(tick.clearance_m <= 0 for tick in self.ticks)])
        return [self.ticks[at] for at in np.flatnonzero(touches[1:] & ~touches[:-1])]


def simulate(
    world: World,
    robot: SimulatedRobot,
    drive: Drive,
    *,
    seconds: float,
    seed: int = 0,
    config: Config | None = None,
    vehicle: Callable[..., Vehicle] = Vehicle,
) -> SimulatedRun:
    """Drive for a number of seconds of simulated time and return the run.

    A map of places (config.places.map) is read, extended and written as by `omnid run`; the pose in the map is computed
    where there is one. Raises OmnidError as `omnid run` does. vehicle: makes the robot; `Vehicle`, or one with faults.
    """
    # 1. The robot, and the lists of what it does.
    config, rig = config or Config(), robot.rig
    run, truth = SimulatedRun(rig.T_base_rig), dict[int, Array]()  # T_world_base by the stamp of a pair [ns]
    body = vehicle(
        world,
        robot,
        config,
        seed,
        lambda tick, _: run.ticks.append(tick),
        lambda time_s, line: run.lines.append((time_s, line)),
    )
    # 2. The stages of the daemon, which work while frames and samples are yielded, and what they give the robot.
    graph = Graph(threaded=False)
    front_end = FrontEnd(geometry(rig, config.panorama), config)
    requests, states = graph.inlet(MAX_OPEN), graph.inlet(1)
    newest = deque[OdometryUpdate](maxlen=1)

    def messages() -> Iterator[Frame | MotionSample]:
        for pair in islice(body.pairs(no_op), int(seconds * robot.rate_hz)):
            if send():
                break
            truth[pair.stamp_ns] = body.T_world_base
            yield from (*pair.samples, *pair.frames)
        body.come_to_rest()

    def send() -> bool:
        """Send what the drive asks for by the newest estimates; return True if it asks for the end."""
        state, ends = body.controller.state, False
        moment = Moment(
            body.time_s,
            body.T_world_base,
            state,
            newest[-1] if newest else None,
            run.poses[-1].T_odom_base if run.poses else np.eye(4),
            run.navigation[-1] if run.navigation else None,
            run.places[-1] if run.places else None,
        )
        arrival_ns = body.now_ns + 1  # after the tick at this time, which has passed
        for request in drive(moment):
            if isinstance(request, Setpoint):
                body.post(TimedSetpoint(arrival_ns, request))
            elif request == "arm":
                body.post(ArmRequest(arrival_ns))
            elif request == "end":
                ends = True
            else:
                states.push(state)
                requests.push(NavigationCommand(request, arrival_ns, arrival_ns, stop_count=state.stop_count))
        states.push(state)
        return ends

    def take_pose(odometry: OdometryUpdate) -> None:
        newest.append(odometry)
        estimate = odometry.of_base(rig.T_base_rig)[0], odometry.state, front_end.motion.is_slipping
        run.poses.append(EstimatedPose(odometry.stamp_ns, truth[odometry.stamp_ns], *estimate))
        body.post(controller_pose(odometry, rig.T_base_rig))

    def take_scan(scan: ObstacleScan) -> None:
        run.scans.append(scan)
        body.post(controller_scan(scan))

    def take_navigation(update: NavigationUpdate) -> None:
        run.navigation.append(update)
        if update.setpoint is not None:
            due_ns = body.now_ns + round(robot.pose_delay_s * NS_PER_S)
            body.post(TimedSetpoint(due_ns, update.setpoint, PLANNER, NAVIGATION_SENDER), due_ns)

    # 3. The run.
    run_places = RunPlaces(config, front_end.geometry, no_op)
    inputs = Inputs([graph.source("cameras", messages)], run_places, requests=requests, states=states)
    streams = wire(config, inputs, front_end, graph)
    graph.sink("poses", take_pose, streams.poses)
    if streams.scans is not None:
        graph.sink("scans", take_scan, streams.scans)
    if streams.in_map is not None and config.places.map:
        graph.sink("in map", run.places.append, streams.in_map)
    if streams.ways is not None:
        graph.sink("planner", take_navigation, streams.ways)
    run_to_end(graph, run_places)
    return run
