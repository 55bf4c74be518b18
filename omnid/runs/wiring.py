"""The wiring of a run: images in, poses, maps and velocity commands out, as in the figure of ARCHITECTURE.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from drivers.frame import Frame
from drivers.motion import MotionSample
from drivers.motor import VelocityCommand
from omnid.config import Config
from omnid.controller.link import DriveLink
from omnid.controller.statistics import ControllerState
from omnid.core.navigation.situation import WheelState
from omnid.engine.graph import NEWEST, Graph, Output, Stream
from omnid.formats.route_file import RouteFolder
from omnid.messages import FramePair, MapUpdate, NavigationUpdate, ObstacleRing, OdometryUpdate, PlaceUpdate
from omnid.runs.place_maps import RunPlaces
from omnid.runs.route_files import Requests, RouteFiles, TaughtRoutes
from omnid.sinks.drive import LiveDrive
from omnid.sinks.encoder import Outgoing, StatusReport
from omnid.stages.front_end import FrontEnd
from omnid.stages.lockstep_drive import LockstepDrive
from omnid.stages.mapping import MapGrid, Mapping
from omnid.stages.navigation import NavigationStage
from omnid.stages.obstacles import CameraFloor, Obstacles
from omnid.stages.places import Places
from omnid.stages.routes import Routes

BUS, FILES, BACKGROUND = "bus", "files", "background"  # threads that several stages and sinks share
RECORDED_DEPTH = 20  # messages of each kind that may wait for the disk of a live recording


@dataclass(frozen=True, slots=True)
class Outputs:
    """The consumers of a run; a map that none of them takes is not computed, nor are places."""

    pairs: dict[str, Output[FramePair]] = field(default_factory=dict)  # each takes the newest
    poses: dict[str, Output[OdometryUpdate]] = field(default_factory=dict)
    counters: dict[str, Output[OdometryUpdate]] = field(default_factory=dict)  # in the thread of the poses: never wait
    commands: dict[str, Output[VelocityCommand]] = field(default_factory=dict)
    maps: dict[str, Output[MapUpdate]] = field(default_factory=dict)
    places: dict[str, Output[PlaceUpdate]] = field(default_factory=dict)
    rings: dict[str, Output[ObstacleRing]] = field(default_factory=dict)  # in the thread of the rings
    bus: Output[Outgoing] | None = None  # takes all messages that leave the run
    recorder: Output[Any] | None = None  # takes them as well
    records_images: bool = False  # the recorder of a live run takes the images, too
    reports: Stream[StatusReport] | None = None  # for bus and recorder

    @property
    def take_all(self) -> bool:
        """True if one of them takes every message that leaves the run."""
        return self.bus is not None or self.recorder is not None


class NavigationParts(NamedTuple):
    """The surroundings of the navigation of a run with wheels."""

    requests: Requests
    states: Stream[ControllerState]  # of the controller; an inlet of the thread that gives the commands
    routes: RouteFolder
    drive: Output[NavigationUpdate]
    map_name: str  # of the file of the map; empty: it is not saved


@dataclass(frozen=True, slots=True)
class Parts:
    """The differences between one run and another: its map of places, its wheels, its rates."""

    map: RunPlaces | None = None  # of places, to begin with, and its file; None: the run's own, where it is consumed
    controller: DriveLink | None = None  # that drives; None: the law in lock-step gives the commands
    navigation: NavigationParts | None = None
    map_every_s: float = 0.0  # between two maps; 0: one, at the end
    map_is_read: Stream[bool] | None = None  # whether the map has a reader; None: it has one


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
    """The stages that are asked for counts and warnings."""

    front_end: FrontEnd
    mapping: Mapping | None
    places: Places | None
    obstacles: Obstacles | None

    @property
    def floor(self) -> CameraFloor | None:
        """The floor that the run uses; None where it needs none."""
        user = self.places or self.obstacles
        return None if user is None else user.floor


def wire(
    graph: Graph,
    frames: Sequence[Stream[Frame | MotionSample]] | Sequence[Stream[Frame]],
    front_end: FrontEnd,
    config: Config,
    outputs: Outputs,
    parts: Parts | None = None,
) -> WiredStages:
    """Join the stages to the images and to the outputs; return those that are asked for counts.

    Live (policy NEWEST), one thread makes a pose of the newest images, so that what is old is dropped before any work.
    Else decoding and dewarping are one bounded inbox ahead of the odometry. Places, obstacles and navigation have a
    thread each. What no wheel waits for shares one: the map, what draws or encodes it, and sinks that write.
    """
    parts, geometry = parts or Parts(), front_end.geometry
    T_base_rig = geometry.rig.T_base_rig
    mapping, places, obstacles = None, None, None
    maps, in_map, grids, rings, written, ways = None, None, None, None, None, None
    run_map, known_places = parts.map, None if parts.map is None else parts.map.places

    # 1. Images give pairs, pairs give panoramas, and these give poses.
    pairs = graph.stage("pair", front_end.pairing, *frames)
    panoramas = graph.stage("dewarp", front_end.dewarp, pairs, thread="pair")
    poses = graph.stage("odometry", front_end.poses, panoramas, thread="pair" if graph.policy is NEWEST else "")

    # 2. Poses go to the controller, which waits for no stage.
    if parts.controller is not None:
        graph.sink("controller", LiveDrive(parts.controller, T_base_rig), poses, thread=poses.thread)
        commands = graph.source("drive", parts.controller.commands, wake=parts.controller.end)
    else:
        law = LockstepDrive(config.controller, 1.0 / config.motor.rate_hz, T_base_rig)
        commands = graph.stage("drive", law, poses, thread=poses.thread)

    # 3. Requests about routes pass through the thread of the files.
    if parts.navigation is not None:
        files = RouteFiles(parts.navigation.routes)
        written = graph.stage("routes", files, parts.navigation.requests.of_routes, thread=FILES)

    # 4. Poses give the map, the pose in it, and the obstacles, where these are consumed.
    if outputs.maps or outputs.take_all:
        mapping = Mapping(config.mapping, front_end.dense, parts.map_every_s)
        noted = () if parts.map_is_read is None else (parts.map_is_read,)
        maps = graph.stage("mapping", mapping, poses, *noted, thread=BACKGROUND)
    needs_places = outputs.places or outputs.take_all or parts.navigation or known_places is not None
    if config.places.enabled and needs_places:
        localize_only, copy_s = (False, 0.0) if run_map is None else (run_map.localize_only, run_map.copy_s)
        places = Places(geometry, config, front_end.dense, known_places, localize_only=localize_only, copy_s=copy_s)
        to_save = None if run_map is None else run_map.requests
        asked: list[Stream[Any]] = [each for each in (written, to_save) if each is not None]
        in_map = graph.stage("places", places, poses, *asked)
        if run_map is not None and to_save is not None:
            graph.sink("save", run_map, in_map, thread=FILES)
    if in_map is not None and outputs.take_all:
        grid = MapGrid(config.mapping.voxel_m, T_base_rig @ geometry.T_rig_rect, parts.map_every_s)
        grids = graph.stage("grid", grid, in_map, thread=BACKGROUND)
    if config.obstacles.enabled and (outputs.rings or outputs.take_all or parts.navigation):
        obstacles = Obstacles(geometry, config.obstacles, front_end.dense)
        rings = graph.stage("obstacles", obstacles, poses)

    # 5. All of them, and requests, give the way to drive.
    if parts.navigation is not None and written is not None:
        requests, states, _, drive, map_name = parts.navigation
        is_new = known_places is None or not known_places.keyframes
        taught = Routes(map_name if places else "", T_base_rig @ geometry.T_rig_rect, is_new=is_new)
        navigation = NavigationStage(config.navigation, config.controller.collision, T_base_rig, taught)
        wheels = graph.stage("wheel-states", wheel_state, states, thread=states.thread)
        seen: list[Stream[Any]] = [stream for stream in (poses, in_map, rings) if stream is not None]
        ways = graph.stage("navigation", navigation, *seen, wheels, requests.direct, written)
        graph.sink("planner", drive, ways, thread=ways.thread)

    # 6. What is made leaves the run.
    taken: list[tuple[dict[str, Any], Stream[Any] | None, str]] = [
        (outputs.counters, poses, poses.thread),
        (outputs.rings, rings, "" if rings is None else rings.thread),
        (outputs.poses, poses, BACKGROUND),
        (outputs.commands, commands, BACKGROUND),
        (outputs.maps, maps, BACKGROUND),
        (outputs.places, in_map, BACKGROUND),
    ]
    for sinks, stream, thread in taken:
        if stream is not None:
            for name, sink in sinks.items():
                graph.sink(name, sink, stream, thread=thread)
    for name, sink in outputs.pairs.items():
        graph.sink(name, sink, pairs, policy=NEWEST, depth=1, thread=BACKGROUND)
    made: list[tuple[str, Stream[Any] | None, str]] = [
        ("bus", poses, BUS),
        ("bus-drive", commands, BUS),
        ("bus-map", maps, FILES),  # to encode a map takes longer than a pose may wait
        ("bus-places", in_map, BUS),
        ("bus-grid", grids, FILES),
        ("bus-scan", rings, BUS),
        ("bus-navigation", ways, BUS),
        ("bus-status", outputs.reports, BUS),
    ]
    outgoing = [(name, stream, thread) for name, stream, thread in made if stream is not None]
    if outputs.recorder is not None:
        images = frames if outputs.records_images else ()
        depth = RECORDED_DEPTH if outputs.records_images else None
        graph.sink("record", outputs.recorder, *images, *(stream for _, stream, _ in outgoing), depth=depth)
    if outputs.bus is not None:
        for name, stream, thread in outgoing:
            graph.sink(name, outputs.bus, stream, policy=NEWEST, thread=thread)

    if parts.navigation is not None and ways is not None:
        graph.sink("taught", TaughtRoutes(parts.navigation.requests), ways, thread=ways.thread)

    # 7. The keyframe of a pair is made when its pose has been passed on: this reader of poses is the last one.
    graph.sink("keyframes", lambda _: front_end.odometry.complete(), poses, thread=poses.thread)
    return WiredStages(front_end, mapping, places, obstacles)
