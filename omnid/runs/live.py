"""A run on the robot: two cameras, the stages, the wheels, the bus, until a signal ends it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Final, Protocol, TypeAlias

import cv2

from calib.rig import Rig
from calib.rig_file import read_rig, rig_toml
from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera, Frame, FrameSource
from omnid.config import Config
from omnid.controller.link import ControllerLink
from omnid.core.control.arming import MANUAL
from omnid.core.control.command_sources import PLANNER
from omnid.diagnostics.latency import Latency
from omnid.diagnostics.load_ladder import PERIOD_S, LoadLadder
from omnid.diagnostics.motion_status import motion_status
from omnid.diagnostics.places_status import places_status
from omnid.diagnostics.rig_monitor import start_status
from omnid.diagnostics.status import StatusCollector, StatusSources, StatusTick
from omnid.diagnostics.terminal_status import TerminalStatus
from omnid.engine.bounded_call import started
from omnid.engine.flow import nothing
from omnid.engine.graph import NEWEST, Graph, Sink
from omnid.engine.kernel_cache import prepare_kernels, read_kept_kernels
from omnid.engine.realtime import ThreadStart, prepare, priorities
from omnid.errors import OmnidError
from omnid.formats.route_file import RouteFolder
from omnid.light.exposure_control import ExposureControl
from omnid.light.grey_levels import UsefulArea
from omnid.messages import OdometryUpdate
from omnid.runs.map_saver import MapSaver
from omnid.runs.pipeline import NavigationParts, Sinks, wheel_state, wire
from omnid.runs.place_maps import RunPlaces
from omnid.runs.record import open_recorder
from omnid.runs.rig_watch import RigWatch
from omnid.runs.sensor_sources import MotionSource, SensorSources
from omnid.runs.session import CAMERAS, TICKERS, Session
from omnid.runs.systemd import Service, StatusLine, print_stacks_when_killed
from omnid.sinks.bus_sink import BusSink, PanoramaSink
from omnid.sinks.command_log import command_recorder
from omnid.sinks.drive import LiveDrive, PlannerDrive, RingToController
from omnid.sinks.encoder import status_report
from omnid.sinks.recorder import Recorder
from omnid.stages.geometry import Geometry, GeometryVersions
from omnid.stages.obstacles import ASSUMED_HEIGHT_M, floor_is_assumed
from omnid.stages.places import Places
from omnid.stages.synchronise import Synchronise
from omnid.transport.bus import Bus
from omnid.transport.codec import DiagnosticStatus, compile_serialisers
from omnid.transport.commands import CommandReceiver
from omnid.transport.navigation_codec import PATH_SCHEMA, STRING_SCHEMA
from omnid.transport.navigation_commands import NavigationReceiver, RequestQueue
from omnid.transport.topics import MAP, MAP_TOPICS, SENSOR_TOPICS, command_topics

MASK_FRAMES: Final = 60  # images of each camera in which the rim is searched, where the rig has no mask
Report: TypeAlias = Callable[[int, str], None]  # level of `logging` and one line
StatusPublisher: TypeAlias = Callable[[list[DiagnosticStatus]], None]


class LiveCamera(FrameSource, Protocol):
    """A source of frames with a state for the status."""

    state: CameraState


OpenCamera: TypeAlias = Callable[[Camera], LiveCamera]  # called a second time after the first camera was closed


class LiveRun:
    """One run of the daemon."""

    def __init__(self, config: Config, open_camera: OpenCamera, report: Report, rig: Rig | None = None,
                 show: Callable[[str], None] | None = None, motion: MotionSource | None = None) -> None:
        """rig: None for that of the configuration. show: rewrites a line of the terminal; None without a terminal.

        motion: wheels and gyro where the images are those of a log; None: those of the robot.
        """
        self._show, self._motion = show, motion
        self._config, self._open_camera, self._report, self._rig = config, open_camera, report, rig
        on_thread = ThreadStart(priorities(config.realtime, *CAMERAS), report)
        self._graph = Graph(policy=NEWEST, depth=1, on_thread=on_thread)
        self._latency = Latency()
        self._connected = False

    def run(self) -> int:
        """Run until a signal comes, or the cameras end; return the exit code."""
        print_stacks_when_killed()
        imported = started(_import_slow_modules, "imports")
        compile_serialisers(PATH_SCHEMA, STRING_SCHEMA)
        offset_ns = time.time_ns() - time.monotonic_ns()
        with ExitStack() as outputs:
            session = Session(self._config, self._graph, outputs, lambda text: self._report(logging.WARNING, text),
                              offset_ns=offset_ns)
            outputs.enter_context(session.signals(self._on_signal))
            geometry = self._geometry(session)
            imported()
            prepare_kernels(self._report)
            self._connected = True
            cameras = {name: outputs.enter_context(closing(self._open_camera(name))) for name in CAMERAS}
            run_places = RunPlaces(self._config, geometry, session.warn)
            self._wire(session, geometry, cameras, run_places)
            cv2.setNumThreads(self._config.graph.opencv_threads)
            for refused in prepare(self._config.realtime):
                session.warn(refused)
            try:
                self._graph.run()
            except BaseException:
                with suppress(OmnidError):  # the error that ended the run is the one that is told
                    run_places.finish()
                raise
            run_places.finish()
        return 0

    def _on_signal(self, number: int, again: bool) -> None:
        """End the program at once while the first images are awaited.

        Later the session has stopped the graph, which ends the run as soon as it begins: an exception while
        connections are opened would leave threads behind that keep Python from ending.
        """
        if not self._connected:
            raise SystemExit(0)

    def _geometry(self, session: Session) -> Geometry:
        rig = self._rig or read_rig(Path(self._config.cameras.rig))
        with closing(self._first_frames()) as frames:
            return session.geometry(rig, frames)

    def _first_frames(self) -> Generator[Frame, None, None]:
        """The first frames of both cameras in turn; the cameras are open until this generator is closed."""
        with ExitStack() as cameras:
            streams = []
            for name in CAMERAS:
                camera = cameras.enter_context(closing(self._open_camera(name)))
                frames = iter(camera.frames())
                cameras.callback(getattr(frames, "close", nothing))  # a generator holds the device until it is closed
                streams.append(islice(frames, MASK_FRAMES))
            for pair in zip(*streams, strict=False):
                yield from pair

    def _wire(self, session: Session, geometry: Geometry, cameras: Mapping[Camera, LiveCamera],
              run_places: RunPlaces) -> None:
        """Join cameras, stages, sinks and tickers."""
        config, graph, rig = self._config, self._graph, geometry.rig
        controller = session.start_controller(config.realtime) if config.motor.port else None
        bus = session.open_bus(rig)
        pairing = Synchronise(rig, config.pair, config.motion.R_base_imu)
        sensors = SensorSources(config, pairing.motion, session, controller, self._report, self._motion)
        if sensors.read_by_thread is not None:
            graph.source("imu" if sensors.gyro else "motion", sensors.read, wake=sensors.read_by_thread.close)
        frames = [graph.source(name, camera.frames, wake=camera.close) for name, camera in cameras.items()]
        versions = GeometryVersions(geometry)
        recorder = self._recorder(session, versions) if config.record.enabled else None
        ladder, requests = LoadLadder(), RequestQueue()
        rig_watch = RigWatch(session, versions, config, ladder, _rig_publisher(bus, recorder),
                             from_log=self._rig is not None)
        self._warn_of_assumed_floor(session, geometry, controller)
        sinks = self._sinks(session, versions, ladder, rig_watch, bus)
        if controller:
            sinks = replace(sinks, live_drive=LiveDrive(controller, rig.T_base_rig, requests.end),
                            navigation=self._navigation(session, controller, requests),
                            rings={"controller-ring": RingToController(controller)})
        sinks = run_places.known_to(replace(sinks, recorder=recorder, recorded_frames=tuple(frames)))
        pairs = graph.stage("pair", pairing, *frames)
        states = {name: camera.state for name, camera in cameras.items()}
        exposure = ExposureControl(UsefulArea(rig, geometry.cylinder), config.cameras, states)
        graph.sink("exposure", exposure, pairs, policy=NEWEST, depth=1)
        stages = wire(graph, pairs, geometry, config, sinks)
        if config.live.shed_load:
            graph.ticker("load", PERIOD_S, partial(ladder.observe, graph.telemetry.of("pair")))
        graph.bound("pair", "odometry")  # images that odometry has no time for are dropped before they are decoded
        saver = self._saver(run_places, stages.places)
        commands = self._command_receiver(controller) if controller else None
        receiver = self._navigation_receiver(requests)
        self._subscribe(session, bus, recorder, commands, receiver, sensors, saver)
        status = [ladder.status, exposure.status, partial(start_status, stages.rig_gate),
                  *([receiver.status] if controller else ()),
                  motion_status(stages.odometry.sensors, pairing.motion, sensors.receiver, sensors.gyro),
                  *([partial(places_status, stages.places)] if stages.places else ()),
                  *(part.status for part in (bus, recorder, *rig_watch.parts, saver) if part)]
        sources = StatusSources(graph.telemetry, states, pairing, session.statistics, self._latency.to_pose,
                                controller.statistics if controller else None, commands, TICKERS, tuple(status))
        self._add_tickers(session, StatusCollector(sources), bus, recorder)

    def _sinks(self, session: Session, versions: GeometryVersions, ladder: LoadLadder, rig_watch: RigWatch, bus: Bus
               ) -> Sinks:
        """Return the sinks of a run that neither drives nor records."""
        config = self._config
        poses: dict[str, Sink[OdometryUpdate]] = {"statistics": session.statistics, "latency": self._latency}
        if config.bus.panorama_hz:
            poses["panorama"] = PanoramaSink(bus, config.bus.panorama_hz, session.offset_ns)
        return Sinks(poses={**poses, **rig_watch.pose_sinks},
                     bus=BusSink(bus, session.encoder(versions, config.live.cloud_points)),
                     rig_monitor=rig_watch.sink, rig_broken=rig_watch.is_broken, versions=versions,
                     features=lambda: ladder.level.features, map_period_s=lambda: ladder.level.map_period_s,
                     ring_period_s=lambda: ladder.level.ring_period_s, map_every_s=config.live.cloud_s,
                     record_depth=config.record.queue)

    def _warn_of_assumed_floor(self, session: Session, geometry: Geometry, controller: ControllerLink | None) -> None:
        """Warn where the wheels depend on a floor that was never measured."""
        looks_ahead = self._config.obstacles.enabled and self._config.controller.collision.check
        if controller and looks_ahead and floor_is_assumed(geometry, self._config.obstacles):
            session.warn(f"the rig has no height above the floor in T_base_rig: obstacles are looked for with a floor "
                         f"{ASSUMED_HEIGHT_M} m below the lower camera; measure it, or set obstacles.ring.floor_m")

    def _saver(self, run_places: RunPlaces, places: Places | None) -> MapSaver | None:
        """Return what saves the map of places now and then; None where it stays as it is."""
        if places is None or not run_places.is_extended:
            return None
        saver = MapSaver(run_places, places, self._config.places.save_s)
        self._graph.ticker("save", saver.PERIOD_S, saver)
        return saver

    def _navigation_receiver(self, requests: RequestQueue) -> NavigationReceiver:
        return NavigationReceiver(requests.put, self._config.controller.deadlines.command_s,
                                  synchronised=self._config.bus.command_clock == "synchronised",
                                  report=partial(self._report, logging.WARNING))

    def _add_tickers(self, session: Session, report: StatusCollector, bus: Bus, recorder: Recorder | None) -> None:
        publishers = [_status_on_bus(bus)]
        if recorder is not None:
            publishers.append(_status_in_recording(recorder, session.offset_ns))
        self._graph.ticker("status", self._config.live.status_s, StatusTick(report, *publishers))
        telemetry = self._graph.telemetry
        status_line = StatusLine(session.statistics, telemetry, TICKERS)
        service = Service(telemetry, status_line, self._config.service.stall_timeout_s)
        self._graph.ticker("watchdog", service.period_s, service)
        if self._show is not None:
            line = StatusLine(session.statistics, telemetry, TICKERS)
            terminal = TerminalStatus(self._show, line, partial(self._report, logging.INFO), session.statistics,
                                      _ready(self._config))
            self._graph.ticker("terminal", terminal.period_s, terminal)

    def _recorder(self, session: Session, versions: GeometryVersions) -> Recorder:
        encode, rig = session.encoder(versions, self._config.record.cloud_points), rig_toml(versions[0].rig)
        recorder = open_recorder(self._config, rig, self._report, encode=encode, offset_ns=session.offset_ns)
        session.outputs.callback(recorder.close)
        return recorder

    def _navigation(self, session: Session, controller: ControllerLink, requests: RequestQueue
                    ) -> NavigationParts | None:
        """Return the surroundings of the navigation; None, with a warning, where its source may not drive."""
        if PLANNER not in self._config.controller.sources.names:
            session.warn(f"controller.sources.names lacks {PLANNER!r}: goals, paths and routes are off")
            return None

        routes = RouteFolder(Path(self._config.navigation.routes))
        return NavigationParts(requests, lambda: wheel_state(controller.statistics.state), PlannerDrive(controller),
                               routes, self._config.places.map)

    def _command_receiver(self, controller: ControllerLink) -> CommandReceiver:
        settings = self._config.controller
        return CommandReceiver(controller, settings.deadlines.command_s, sources=settings.sources.names,
                               synchronised=self._config.bus.command_clock == "synchronised",
                               report=partial(self._report, logging.WARNING))

    def _subscribe(self, session: Session, bus: Bus, recorder: Recorder | None, commands: CommandReceiver | None,
                   navigation: NavigationReceiver, sensors: SensorSources, saver: MapSaver | None) -> None:
        """Take commands, requests and samples from the bus; without a motor samples and requests to save the map."""
        topics = {**SENSOR_TOPICS, **MAP_TOPICS} if commands is None else \
            command_topics(self._config.controller.sources.names)
        record = nothing if recorder is None else command_recorder(recorder, session.offset_ns, topics)

        def receive(key: str, payload: bytes, sender: str, sent_ns: int) -> None:
            if sensors.receiver.handles(key):
                sensors.receiver.receive(key, payload)
                return  # samples are recorded with the poses
            if key == MAP and saver is not None:
                saver.receive(payload)
            if key == MAP or commands is None:
                return
            if navigation.handles(key):
                navigation.receive(key, payload, sent_ns)
            else:
                commands.receive(key, payload, sender, sent_ns)  # before it is recorded: a stop must not wait
            record(key, payload)

        bus.subscribe_commands(receive, topics)


def _import_slow_modules() -> None:
    """Import what takes a second, while images are awaited; where that fails, the users of it raise."""
    with suppress(Exception):
        read_kept_kernels()
        import_module("filterpy.kalman")


def _ready(config: Config) -> str:
    """Return what to do now that the run is ready."""
    endpoints = ", ".join(config.bus.connect if config.bus.mode == "client" else config.bus.listen)
    wheels = "; no motor" if not config.motor.port else \
        "; the wheels turn after `omnid arm`" if config.controller.arming == MANUAL else ""
    return f"ready: poses of {config.bus.robot!r} at {endpoints or 'no endpoint'} (`omnid listen`){wheels}; Ctrl-C ends"


def _rig_publisher(bus: Bus, recorder: Recorder | None) -> Callable[[Rig], None]:
    """Return a function that publishes a refined rig, and records it."""

    def publish(rig: Rig) -> None:
        bus.serve("rig", rig_toml(rig))
        if recorder is not None:
            recorder.attach("rig.toml", rig_toml(rig).encode())

    return publish


def _status_on_bus(bus: Bus) -> StatusPublisher:
    """Return a function that publishes statuses; where the bus is slow, only the status ticker waits."""

    def publish(statuses: list[DiagnosticStatus]) -> None:
        with suppress(OmnidError):  # the system's clock may be set to a time that no message can hold
            message = status_report(time.time_ns(), statuses)
            bus.publish(message.topic, message.payload)

    return publish


def _status_in_recording(recorder: Recorder, offset_ns: int) -> StatusPublisher:
    """Return a function that records statuses, in the time of all other messages also when the clock was set."""

    def record(statuses: list[DiagnosticStatus]) -> None:
        now_ns = time.monotonic_ns() + offset_ns
        with suppress(OmnidError):  # as above
            recorder.add(status_report(now_ns, statuses), now_ns)

    return record
