"""The wiring of the stages: image pairs in, poses, maps and velocity commands out."""

from __future__ import annotations

import math
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
from omnid.engine.flow import Chain
from omnid.engine.graph import NEWEST, Graph, Sink, Stream
from omnid.messages import (
    FramePair,
    GridUpdate,
    MapUpdate,
    NavigationUpdate,
    ObstacleRing,
    OdometryUpdate,
    PlaceUpdate,
)
from omnid.runs.route_map import RunRouteMap
from omnid.sinks.drive import LiveDrive, ReplayDrive
from omnid.sinks.encoder import Outgoing
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry, GeometryVersions
from omnid.stages.grid import MapGrid
from omnid.stages.lockstep_drive import LockstepDrive
from omnid.stages.mapping import Mapping, no_wait
from omnid.stages.navigation import NavigationStage
from omnid.stages.obstacles import Obstacles
from omnid.stages.odometry import OdometryStage, all_features
from omnid.stages.places import Places
from omnid.stages.rig_gate import RigGate, never
from omnid.stages.routes import Routes, RouteStore
from omnid.stages.stereo import Stereo


@dataclass(frozen=True, slots=True)
class Sinks:
    """The consumers of a run; a map that no sink takes is not computed, nor are places."""

    poses: dict[str, Sink[OdometryUpdate]] = field(default_factory=dict)
    maps: dict[str, Sink[MapUpdate]] = field(default_factory=dict)
    places: dict[str, Sink[PlaceUpdate]] = field(default_factory=dict)
    rings: dict[str, Sink[ObstacleRing]] = field(default_factory=dict)
    known_places: PlaceMap | None = None  # the map to begin with; None: the run's own, where it is consumed
    localize_only: bool = False  # it stays as it is
    recorder: Sink[Any] | None = None  # of all messages that leave the run, and of recorded_frames
    bus: Sink[Outgoing] | None = None
    live_drive: LiveDrive | None = None  # its commands are those that are published and recorded
    replay_drive: ReplayDrive | None = None  # beside the lock-step commands, which are published and recorded
    rig_gate: RigGate | None = None  # that has seen pairs of the log already; None: the run's own
    rig_monitor: Sink[OdometryUpdate] | None = None
    rig_broken: Callable[[], bool] = never  # what the rig monitor has found
    navigation: NavigationParts | None = None
    versions: GeometryVersions | None = None  # of a run that refines its rig; None: the rig stays
    features: Callable[[], float] = all_features  # share of the landmarks of a keyframe, under overload
    map_period_s: Callable[[], float] = no_wait  # least time between two pairs that enter the map, under overload
    ring_period_s: Callable[[], float] = no_wait  # least time between two obstacle rings, under overload
    map_every_s: float = 0.0  # between two maps; 0: one, at the end
    recorded_frames: tuple[Stream[Frame], ...] = ()
    record_depth: int | None = None  # messages of each kind that may wait for the recorder


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
    routes: RouteStore
    map_name: str  # of the file of the map; empty: it is not saved


def wheel_state(state: ControllerState) -> WheelState:
    """Return the part of the controller's state that the navigation needs."""
    return WheelState(state.armed, state.needs_request, state.disarmed_by, state.reason, state.source,
                      state.obstacle if state.blocked else "")


class WiredStages(NamedTuple):
    """The stages that are asked for counts and warnings at the end of a run."""

    rig_gate: RigGate
    odometry: OdometryStage
    mapping: Mapping | None
    places: Places | None


def wire(graph: Graph, pairs: Stream[FramePair], geometry: Geometry, config: Config, sinks: Sinks) -> WiredStages:
    """Join the stages from the pairs on; return those that are asked at the end."""
    rig_gate = sinks.rig_gate or RigGate(geometry.cylinder, config.stereo.rig_check, sinks.rig_broken)
    versions = sinks.versions or GeometryVersions(geometry)
    stereo = Stereo(versions, config.stereo_settings(), rig_gate)
    panoramas = graph.stage("dewarp", Dewarp(versions, config.panorama, config.camera), pairs, direct=True)
    odometry_stage = OdometryStage(versions, config.odometry, sinks.features)
    poses = Chain(stereo, odometry_stage)
    odometry = graph.stage("odometry", poses, panoramas)
    if sinks.rig_monitor:
        graph.sink("rig", sinks.rig_monitor, odometry, policy=NEWEST, depth=1)
    outgoing: dict[str, Stream[Outgoing]] = {
        "bus": odometry, "bus-drive": _commands(graph, odometry, geometry, config, sinks)}
    mapping, maps = _mapping(graph, odometry, config, sinks)
    places, in_map = _places(graph, odometry, geometry, config, sinks)
    grids = _grids(graph, in_map, geometry, config, sinks)
    rings = _rings(graph, odometry, geometry, config, sinks)
    updates = _navigation(graph, geometry, config, sinks.navigation, places,
                          [odometry, *(stream for stream in (in_map, rings) if stream)])
    named = {"bus-map": maps, "bus-places": in_map, "bus-grid": grids, "bus-scan": rings, "bus-navigation": updates}
    outgoing.update({name: stream for name, stream in named.items() if stream})
    for name, pose_sink in sinks.poses.items():
        graph.sink(name, pose_sink, odometry)
    if sinks.recorder:
        graph.sink("record", sinks.recorder, *sinks.recorded_frames, *outgoing.values(), depth=sinks.record_depth)
    if sinks.bus:
        for name, stream in outgoing.items():  # an inbox each: to encode a map takes longer than a pose may wait
            graph.sink(name, sinks.bus, stream, policy=NEWEST)
    return WiredStages(rig_gate, odometry_stage, mapping, places)


def _mapping(graph: Graph, odometry: Stream[OdometryUpdate], config: Config, sinks: Sinks
             ) -> tuple[Mapping | None, Stream[MapUpdate] | None]:
    """Join the map; None where no sink takes it."""
    if not (sinks.maps or sinks.recorder or sinks.bus):
        return None, None
    mapping = Mapping(config.mapping, sinks.map_every_s, sinks.map_period_s)
    maps = graph.stage("mapping", mapping, odometry)
    for name, sink in sinks.maps.items():
        graph.sink(name, sink, maps)
    return mapping, maps


def _places(graph: Graph, odometry: Stream[OdometryUpdate], geometry: Geometry, config: Config, sinks: Sinks
            ) -> tuple[Places | None, Stream[PlaceUpdate] | None]:
    """Join the places; None where they are not consumed."""
    is_known = sinks.known_places is not None
    if not config.places.enabled or not (sinks.places or sinks.recorder or sinks.bus or sinks.navigation or is_known):
        return None, None
    places = Places(geometry, config, sinks.known_places, localize_only=sinks.localize_only,
                    is_overloaded=lambda: sinks.map_period_s() == math.inf)
    in_map = graph.stage("places", places, odometry)
    for name, sink in sinks.places.items():
        graph.sink(name, sink, in_map)
    return places, in_map


def _grids(graph: Graph, in_map: Stream[PlaceUpdate] | None, geometry: Geometry, config: Config, sinks: Sinks
           ) -> Stream[GridUpdate] | None:
    """Join the occupancy grid of the places; None where it is not consumed."""
    if in_map is None or not (sinks.recorder or sinks.bus):
        return None
    T_base_rect = geometry.rig.T_base_rig @ geometry.T_rig_rect
    return graph.stage("grid", MapGrid(config.mapping.voxel_m, T_base_rect, sinks.map_every_s, sinks.map_period_s),
                       in_map)


def _rings(graph: Graph, odometry: Stream[OdometryUpdate], geometry: Geometry, config: Config, sinks: Sinks
           ) -> Stream[ObstacleRing] | None:
    """Join the obstacle ring; None where it is not consumed."""
    if not config.obstacles.enabled or not (sinks.rings or sinks.recorder or sinks.bus or sinks.navigation):
        return None
    rings = graph.stage("obstacles", Obstacles(geometry, config.obstacles, sinks.ring_period_s), odometry)
    for name, sink in sinks.rings.items():
        graph.sink(name, sink, rings)
    return rings


def _navigation(graph: Graph, geometry: Geometry, config: Config, parts: NavigationParts | None,
                places: Places | None, inputs: Sequence[Stream[Any]]) -> Stream[NavigationUpdate] | None:
    """Join the navigation, whose setpoints go to the controller; None in a run without wheels."""
    if parts is None:
        return None
    T_base_rig = geometry.rig.T_base_rig
    route_map = None if places is None else RunRouteMap(places, T_base_rig, parts.map_name)
    navigation = NavigationStage(config.navigation, config.controller.collision, T_base_rig, parts.wheels,
                                 Routes(parts.routes, route_map))
    requests = graph.source("requests", parts.requests.batches, wake=parts.requests.end)
    updates = graph.stage("navigation", navigation, *inputs, requests)
    graph.sink("planner", parts.drive, updates, policy=NEWEST, depth=1)
    return updates


def _commands(graph: Graph, odometry: Stream[OdometryUpdate], geometry: Geometry, config: Config, sinks: Sinks
              ) -> Stream[VelocityCommand]:
    """Join the controller; return its commands. It never waits for a stage: it has a process of its own."""
    if sinks.live_drive:
        graph.sink("controller", sinks.live_drive, odometry, policy=NEWEST, depth=1)
        return graph.source("drive", sinks.live_drive.commands, wake=sinks.live_drive.end)
    if sinks.replay_drive:
        graph.sink("controller", sinks.replay_drive, odometry)
    period_s = 1.0 / config.motor.rate_hz
    return graph.stage("drive", LockstepDrive(config.controller, period_s, geometry.rig.T_base_rig), odometry)
