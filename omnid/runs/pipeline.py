"""The wiring of the stages: image pairs in, poses, maps and velocity commands out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from drivers.frame import Frame
from drivers.motor import VelocityCommand
from omnid.config import Config
from omnid.controller.statistics import ControllerState
from omnid.core.navigation.requests import NavigationCommand
from omnid.core.navigation.situation import WheelState
from omnid.core.places.place_map import PlaceMap
from omnid.engine.graph import NEWEST, Graph, Sink, Stream
from omnid.load_level import Load, full_load
from omnid.messages import (
    FramePair,
    GridUpdate,
    MapUpdate,
    NavigationUpdate,
    ObstacleRing,
    OdometryUpdate,
    PlaceUpdate,
)
from omnid.sinks.drive import LiveDrive, ReplayDrive, SimulatedWheels
from omnid.sinks.encoder import Outgoing
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry
from omnid.stages.lockstep_drive import LockstepDrive
from omnid.stages.mapping import MapGrid, Mapping, always
from omnid.stages.navigation import NavigationStage
from omnid.stages.obstacles import CameraFloor, Obstacles
from omnid.stages.places import Places
from omnid.stages.routes import RouteMap, Routes


class RecordingSink(NamedTuple):
    """The recorder of a run, which takes all messages that leave the run."""

    sink: Sink[Any]
    frames: tuple[Stream[Frame], ...] = ()  # recorded too
    depth: int | None = None  # messages of each kind that may wait for the recorder; None: as for other sinks


@dataclass(frozen=True, slots=True)
class Sinks:
    """The consumers of a run; a map that no sink takes is not computed, nor are places."""

    poses: dict[str, Sink[OdometryUpdate]] = field(default_factory=dict)
    maps: dict[str, Sink[MapUpdate]] = field(default_factory=dict)
    places: dict[str, Sink[PlaceUpdate]] = field(default_factory=dict)
    rings: dict[str, Sink[ObstacleRing]] = field(default_factory=dict)
    bus: Sink[Outgoing] | None = None
    recording: RecordingSink | None = None
    counters: dict[str, Sink[OdometryUpdate]] = field(default_factory=dict)  # of poses, in the thread of the odometry

    @property
    def take_all(self) -> bool:
        """True if a sink takes every message that leaves the run."""
        return self.bus is not None or self.recording is not None


@dataclass(frozen=True, slots=True)
class RunParts:
    """The differences between one run and another: its map of places, its wheels, its rates."""

    known_places: PlaceMap | None = None  # the map to begin with; None: the run's own, where it is consumed
    localize_only: bool = False  # the known map stays as it is
    # LiveDrive: its commands are published and recorded. The others belong to a replay: the lock-step commands are.
    drive: LiveDrive | ReplayDrive | SimulatedWheels | None = None
    navigation: NavigationParts | None = None
    load: Load = full_load
    map_every_s: float = 0.0  # between two maps; 0: one, at the end
    map_is_read: Callable[[], bool] = always  # True while the map has a reader


class RequestSource(Protocol):
    """Requests to the navigation; `end` ends `batches`."""

    def batches(self) -> Iterator[Iterable[NavigationCommand]]:
        """Yield requests."""

    def end(self) -> None:
        """End `batches`; from any thread."""


class NavigationParts(NamedTuple):
    """The surroundings of the navigation of a run with wheels."""

    requests: RequestSource
    wheels: Callable[[], WheelState]
    drive: Sink[NavigationUpdate]
    map_name: str  # of the file of the map; empty: it is not saved


def wheel_state(state: ControllerState) -> WheelState:
    """Return the part of the controller's state that the navigation needs."""
    return WheelState(
        state.armed,
        state.needs_request,
        state.disarmed_by,
        state.reason,
        state.source,
        state.obstacle if state.blocked else "",
        state.halts,
        state.halted_by,
    )


class WiredStages(NamedTuple):
    """The stages that are asked for counts and warnings at the end of a run."""

    front_end: FrontEnd
    mapping: Mapping | None
    places: Places | None
    obstacles: Obstacles | None = None

    @property
    def floor(self) -> CameraFloor | None:
        """The floor that the run uses; None where it needs none."""
        user = self.places or self.obstacles
        return None if user is None else user.floor


def wire(
    graph: Graph,
    pairs: Stream[FramePair],
    front_end: FrontEnd,
    config: Config,
    sinks: Sinks,
    parts: RunParts | None = None,
) -> WiredStages:
    """Join the stages from the pairs on; return those that are asked at the end."""
    geometry, parts = front_end.geometry, parts or RunParts()
    # 1. Pairs give poses.
    panoramas = graph.stage("dewarp", front_end.dewarp, pairs, direct=True)
    odometry = graph.stage("odometry", front_end.poses, panoramas)
    commands = _commands(graph, odometry, geometry, config, parts.drive)
    # 2. Poses give maps and rings, where these are consumed.
    mapping, maps = _mapping(graph, odometry, front_end, config, sinks, parts)
    places, in_map = _places(graph, odometry, front_end, config, sinks, parts)
    grids = _grids(graph, in_map, geometry, config, parts) if sinks.take_all else None
    obstacles, rings = _rings(graph, odometry, front_end, config, sinks, parts)
    # 3. All of them give the way.
    updates = _navigation(
        graph, geometry, config, parts, places, [odometry, *(stream for stream in (in_map, rings) if stream)]
    )
    # 4. What is made leaves the run.
    for name, pose_sink in sinks.poses.items():
        graph.sink(name, pose_sink, odometry)
    for name, counter in sinks.counters.items():
        graph.sink(name, counter, odometry, direct=True)
    named = {
        "bus": odometry,
        "bus-drive": commands,
        "bus-map": maps,
        "bus-places": in_map,
        "bus-grid": grids,
        "bus-scan": rings,
        "bus-navigation": updates,
    }
    _send(graph, {name: stream for name, stream in named.items() if stream}, sinks)
    return WiredStages(front_end, mapping, places, obstacles)


def _send(graph: Graph, outgoing: dict[str, Stream[Outgoing]], sinks: Sinks) -> None:
    """Join the recorder and the bus, which take every stream that leaves the run."""
    if sinks.recording:
        recorder, frames, depth = sinks.recording
        graph.sink("record", recorder, *frames, *outgoing.values(), depth=depth)
    if sinks.bus:
        for name, stream in outgoing.items():  # an inbox each: to encode a map takes longer than a pose may wait
            graph.sink(name, sinks.bus, stream, policy=NEWEST)


def _mapping(
    graph: Graph, odometry: Stream[OdometryUpdate], front_end: FrontEnd, config: Config, sinks: Sinks, parts: RunParts
) -> tuple[Mapping | None, Stream[MapUpdate] | None]:
    """Join the map; None where no sink takes it."""
    if not (sinks.maps or sinks.take_all):
        return None, None
    mapping = Mapping(config.mapping, front_end.dense, parts.map_every_s, parts.load, parts.map_is_read)
    maps = graph.stage("mapping", mapping, odometry)
    for name, sink in sinks.maps.items():
        graph.sink(name, sink, maps)
    return mapping, maps


def _places(
    graph: Graph, odometry: Stream[OdometryUpdate], front_end: FrontEnd, config: Config, sinks: Sinks, parts: RunParts
) -> tuple[Places | None, Stream[PlaceUpdate] | None]:
    """Join the places; None where they are not consumed."""
    is_consumed = sinks.places or sinks.take_all or parts.navigation or parts.known_places is not None
    if not config.places.enabled or not is_consumed:
        return None, None
    places = Places(
        front_end.geometry,
        config,
        front_end.dense,
        parts.known_places,
        localize_only=parts.localize_only,
        load=parts.load,
    )
    in_map = graph.stage("places", places, odometry)
    for name, sink in sinks.places.items():
        graph.sink(name, sink, in_map)
    return places, in_map


def _grids(
    graph: Graph, in_map: Stream[PlaceUpdate] | None, geometry: Geometry, config: Config, parts: RunParts
) -> Stream[GridUpdate] | None:
    """Join the occupancy grid of the places; None without places."""
    if in_map is None:
        return None
    T_base_rect = geometry.rig.T_base_rig @ geometry.T_rig_rect
    return graph.stage("grid", MapGrid(config.mapping.voxel_m, T_base_rect, parts.map_every_s, parts.load), in_map)


def _rings(
    graph: Graph, odometry: Stream[OdometryUpdate], front_end: FrontEnd, config: Config, sinks: Sinks, parts: RunParts
) -> tuple[Obstacles | None, Stream[ObstacleRing] | None]:
    """Join the obstacle ring; None where it is not consumed."""
    if not config.obstacles.enabled or not (sinks.rings or sinks.take_all or parts.navigation):
        return None, None
    obstacles = Obstacles(front_end.geometry, config.obstacles, front_end.dense, parts.load)
    rings = graph.stage("obstacles", obstacles, odometry)
    for name, sink in sinks.rings.items():
        graph.sink(name, sink, rings)
    return obstacles, rings


def _navigation(
    graph: Graph,
    geometry: Geometry,
    config: Config,
    parts: RunParts,
    places: Places | None,
    inputs: Sequence[Stream[Any]],
) -> Stream[NavigationUpdate] | None:
    """Join the navigation, whose setpoints go to the controller; None in a run without wheels."""
    given, T_base_rig = parts.navigation, geometry.rig.T_base_rig
    if given is None:
        return None
    is_new = parts.known_places is None or not parts.known_places.keyframes
    route_map = RouteMap(given.map_name, T_base_rig, geometry.T_rig_rect, is_new=is_new) if places else None
    navigation = NavigationStage(
        config.navigation, config.controller.collision, T_base_rig, given.wheels, Routes(route_map)
    )
    requests = graph.source("requests", given.requests.batches, wake=given.requests.end)
    updates = graph.stage("navigation", navigation, *inputs, requests)
    graph.sink("planner", given.drive, updates, policy=NEWEST, depth=1)
    return updates


def _commands(
    graph: Graph,
    odometry: Stream[OdometryUpdate],
    geometry: Geometry,
    config: Config,
    drive: LiveDrive | ReplayDrive | SimulatedWheels | None,
) -> Stream[VelocityCommand]:
    """Join the controller; return its commands. It never waits for a stage: that of a motor has its own process."""
    if isinstance(drive, LiveDrive):
        graph.sink("controller", drive, odometry, policy=NEWEST, depth=1)
        return graph.source("drive", drive.commands, wake=drive.end)
    if isinstance(drive, ReplayDrive):
        graph.sink("controller", drive, odometry)
    period_s = 1.0 / config.motor.rate_hz
    commands = graph.stage("drive", LockstepDrive(config.controller, period_s, geometry.rig.T_base_rig), odometry)
    if isinstance(drive, SimulatedWheels):
        graph.sink("wheels", drive, commands)
    return commands
