"""The wiring of a run: images in, poses, maps and velocity commands out, as in the figure of ARCHITECTURE.md."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2

from calib.models.names import sees_directly
from calib.rig import Rig
from calib.rig_file import parse_rig, rig_toml
from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from drivers.motion import MotionSample
from omnid.config import Config
from omnid.controller.link import DriveLink
from omnid.core.control.control_law import ControllerState
from omnid.core.navigation.requests import NavigationCommand
from omnid.diagnostics.status import RunStatistics
from omnid.engine.graph import Graph, Poller, Step, Stream, run_in_thread
from omnid.errors import OmnidError
from omnid.formats.route_file import RouteFolder
from omnid.messages import (
    FramePair,
    MapUpdate,
    NavigationUpdate,
    ObstacleScan,
    OdometryUpdate,
    PlaceUpdate,
)
from omnid.runs.files import RouteFiles, RunPlaces
from omnid.settings import dump
from omnid.sinks.drive import LiveDrive, arming_answers, navigation_answers
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry, geometry, with_rims
from omnid.stages.mapping import MapGrid, Mapping, Places
from omnid.stages.navigation import NavigationStage
from omnid.stages.obstacles import Obstacles
from omnid.transport import status_names
from omnid.transport.bus import Bus
from omnid.transport.topics import MAX_OPEN, Answers

BUS_S: Final = 3.0  # Time until a bus must be closed.

BUS, FILES, BACKGROUND = "bus", "files", "background"  # threads that several stages and sinks share


def attached_rig(reader: LogReader, log: object) -> Rig:
    """Return the rig of the rig.toml that is attached to the log; OmnidError if there is none."""
    attached = reader.attachments().get("rig.toml")
    if attached is None:
        raise OmnidError(
            f"{log}: no rig.toml is attached to the log; give one with --rig, made by `omnid calibrate rig`, or "
            "`omnid calibrate import` from a file of Kalibr or OCamCalib"
        )
    return parse_rig(attached, f"{log}: attached rig.toml")


def run_to_end(graph: Graph, run_places: RunPlaces) -> None:
    """Run until the end, then complete the map of places, also after a failure, which is the error that is raised."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the stages are threads themselves
    try:
        graph.run()
    except BaseException:
        with suppress(OmnidError):
            run_places.finish_run()
        raise
    finally:
        cv2.setNumThreads(threads)
    run_places.finish_run()


@dataclass(slots=True)
class Session:
    """One run."""

    config: Config
    graph: Graph
    outputs: ExitStack  # closes them in reverse order
    warn: Callable[[str], None]  # takes a line for the user
    statistics: RunStatistics
    # Numbers of the parts of a live run, by their names.
    parts: dict[str, Callable[[], status_names.Stats]] = field(default_factory=dict)

    def geometry(self, rig: Rig, frames: Iterable[Frame]) -> Geometry:
        """Return the geometry of the rig; its missing masks are looked for in frames of a log."""
        rig = with_rims(rig, frames)
        for name, camera in rig.sides:
            if camera.mask is None and not sees_directly(camera.camera):
                self.warn(
                    f"no mirror rim is known of the {name} camera: the largest disc is used; give it in the rig's file "
                    f"under [{name}.mask], by `omnid calibrate drive --only mask`"
                )
        return geometry(rig, self.config.panorama)

    def every(self, period_s: float, action: Callable[[], object], name: str) -> None:
        """Call an action each period, in a thread of its own, until the outputs are closed."""
        self.outputs.callback(Poller(action, period_s, name).close)

    def open_bus(self, rig: Rig, *, gives_time: bool) -> Bus:
        """Open the bus; it answers queries for the configuration and the rig. gives_time: as Bus has it."""
        bus = Bus(self.config.bus, self.warn, gives_time=gives_time)

        def close() -> None:
            closing = run_in_thread(bus.close, "bus-close")
            closing.join(BUS_S)  # zenoh waits for subscribers that do not read, for 10 s; a service has less time
            if closing.is_alive():
                self.warn(f"the bus has not closed within {BUS_S:g} s: a subscriber does not read")

        self.outputs.callback(close)
        self.parts[status_names.BUS] = bus.stats
        bus.serve("config", dump(self.config))
        bus.serve("rig", rig_toml(rig))
        return bus


@dataclass(frozen=True, slots=True)
class Inputs:
    """The inputs of a run: images, its map of places, its wheels."""

    frames: Sequence[Stream[Frame | MotionSample]]
    map: RunPlaces  # of places, to begin with, and its file
    controller: DriveLink | None = None  # of a live run; its commands leave the run
    requests: Stream[NavigationCommand] | None = None  # None: the run does not navigate
    states: Stream[ControllerState] | None = None  # of the controller, which the navigation needs
    saves: Stream[int] | None = None  # ids of requests to save the map; None: it is saved at the end only
    map_every_s: float = 0.0  # between two maps; 0: one, at the end


class Leaving(NamedTuple):
    """A stream of messages that leave the run: what they are about, and the thread in which they are published."""

    about: str
    stream: Stream[Any]
    thread: str = BUS


@dataclass(frozen=True, slots=True)
class Streams:
    """The results of a run, for its sinks; what nobody reads is not computed. None: the run has none."""

    pairs: Stream[FramePair]
    poses: Stream[OdometryUpdate]
    maps: Stream[MapUpdate]
    in_map: Stream[PlaceUpdate] | None
    scans: Stream[ObstacleScan] | None
    ways: Stream[NavigationUpdate] | None
    leaving: list[Leaving]
    answers: Sequence[Stream[Answers]]  # to requests
    places: Places | None  # the stage of `in_map`

    def publish(self, graph: Graph, sink: Step[Any, None]) -> None:
        """Have all messages that leave the run published."""
        for about, stream, thread in self.leaving:
            graph.sink(f"bus-{about}", sink, stream, thread=thread)


def wire(config: Config, inputs: Inputs, front_end: FrontEnd, graph: Graph) -> Streams:
    """Join the stages to the inputs; return their results.

    Where inboxes drop, one thread makes a pose of the newest images, so that old images are dropped before any work.
    Else decoding and dewarping are one bounded inbox ahead of the odometry. Places, obstacles and navigation have a
    thread each. Work that the wheels do not wait for shares one: the map, its drawing and encoding, and file sinks.
    """
    geometry, run_map, controller = front_end.geometry, inputs.map, inputs.controller
    T_base_rig, T_base_rect = geometry.rig.T_base_rig, geometry.T_base_rect
    places, in_map, scans, ways = None, None, None, None
    answers: list[Stream[Answers]] = []

    # 1. Images give pairs, pairs give panoramas, and these give poses.
    pairs = graph.stage("pair", front_end.pairing, *inputs.frames)
    panoramas = graph.stage("dewarp", front_end.dewarp, pairs, thread="pair")
    poses = graph.stage("odometry", front_end, panoramas, thread="pair" if graph.drops else "")
    leaving = [Leaving("poses", poses)]

    # 2. Poses go to the controller, which waits for no stage.
    drive: LiveDrive | None = None
    if controller is not None:
        drive = LiveDrive(controller, T_base_rig, front_end.health)
        graph.sink("controller", drive, poses, thread=poses.thread)
        leaving.append(Leaving("drive", graph.source("drive", controller.commands, wake=controller.end)))

    # 3. Poses give the map, the pose in it, and the obstacles. A map that is extended needs no reader.
    mapping = Mapping(config.mapping, front_end.dense, inputs.map_every_s, keyframes_only=graph.drops)
    maps = graph.stage("mapping", mapping, poses, thread=BACKGROUND)
    leaving.append(Leaving("map", maps, FILES))  # to encode a map takes longer than a pose may wait
    if config.places.enabled:
        places = Places(geometry, config, front_end.dense, run_map.places)
        in_map = (graph.stage if run_map.places is None else graph.sink)("places", places, poses)
        grid = MapGrid(config.mapping.voxel_m, T_base_rect, inputs.map_every_s)
        grids = graph.stage("grid", grid, in_map, thread=BACKGROUND)
        leaving += [Leaving("places", in_map), Leaving("grid", grids, FILES)]
    if config.obstacles.enabled:
        scans = graph.stage("obstacles", Obstacles(geometry, config.obstacles), poses)
        leaving.append(Leaving("scan", scans))
        if drive is not None:
            graph.sink("controller-scan", drive, scans, thread=scans.thread)

    # 4. All of them, and requests, give the way to drive. Routes and copies of the map are written by another thread.
    if in_map is not None and inputs.saves is not None:
        asked: list[Stream[PlaceUpdate | int]] = [in_map, inputs.saves]
        copies = graph.stage("map-copies", run_map.copy, *asked, thread=in_map.thread)
        answers.append(graph.sink("save", run_map.write, copies, thread=FILES, depth=MAX_OPEN))
    requests, states = inputs.requests, inputs.states
    if requests is not None and states is not None:
        files = RouteFiles(RouteFolder(Path(config.navigation.routes)), inputs.saves)
        of_base = config.controller.collision, T_base_rig, T_base_rect
        map_name = config.places.map if places else ""
        stage = NavigationStage(config.navigation, *of_base, map_name, files.routes, is_new=run_map.is_new)
        inbox: list[Stream[Any] | None] = [poses, in_map, scans, states, requests]
        ways = graph.stage("navigation", stage, *(stream for stream in inbox if stream is not None))
        leaving.append(Leaving("navigation", ways))
        answers.append(graph.stage("arming", arming_answers, states, thread=states.thread))
        answers.append(graph.stage("answers", navigation_answers, ways, thread=ways.thread))
        answers.append(graph.sink("taught", files.write, ways, thread=FILES))
        if drive is not None:
            graph.sink("planner-drive", drive, ways, thread=ways.thread)
    return Streams(pairs, poses, maps, in_map, scans, ways, leaving, answers, places)
