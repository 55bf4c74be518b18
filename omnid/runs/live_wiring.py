"""Wiring of a live run: commands from the bus, and the streams between cameras, stages, controller and sinks."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final, TypeAlias

from calib.rig_file import rig_toml
from drivers.frame import Frame
from drivers.motor import VelocityCommand
from omnid.controller.link import DriveLink
from omnid.core.control.arming import ArmAnswer
from omnid.core.control.command_sources import PLANNER
from omnid.core.control.safety_rules import AWAITED, NO_POSE
from omnid.core.navigation.requests import NavigationCommand
from omnid.core.rig.rig_health import RigHealth
from omnid.diagnostics.load_ladder import PERIOD_S, LoadLadder
from omnid.diagnostics.part_status import (
    ImagesStatus,
    clock_status,
    floor_status,
    motion_status,
    places_status,
    rig_status,
)
from omnid.diagnostics.status import Latency, StatusCollector, StatusSources
from omnid.engine.graph import NEWEST, Sink, Stream
from omnid.engine.logging_setup import Report
from omnid.engine.robot_clock import RobotClock, SegmentTime
from omnid.formats.route_file import RouteFolder
from omnid.light.exposure import ExposureControl, UsefulArea
from omnid.load_level import LoadLevel
from omnid.messages import OdometryUpdate
from omnid.runs.live import LiveRobot, add_status_tickers
from omnid.runs.pipeline import NavigationParts, RecordingSink, RunParts, Sinks, WiredStages, wheel_state, wire
from omnid.runs.place_maps import MapSaver, RunPlaces
from omnid.runs.record import WAITING_RECORDS, open_recorder
from omnid.runs.rig_checks import RigViews
from omnid.runs.route_files import RouteFiles
from omnid.runs.sensor_sources import SensorSources
from omnid.runs.session import BUS_POINTS, LOG_POINTS, TICKERS, Session
from omnid.sinks.bus_sink import BusSink, PanoramaSink
from omnid.sinks.drive import LiveDrive, PlannerDrive, RingToController
from omnid.sinks.recorder import Recorder
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry
from omnid.stages.obstacles import ADVICE
from omnid.stages.places import Places
from omnid.stages.synchronise import Synchronise
from omnid.transport.bus import Bus
from omnid.transport.commands import CommandReceiver, Freshness, NavigationReceiver, RequestQueue
from omnid.transport.requests import Answer, Request
from omnid.transport.status_names import DISARMED_BY_STOP
from omnid.transport.topics import ARM, MAP, MAP_TOPICS, NAVIGATION_TOPICS, SENSOR_TOPICS, TIME, command_topics

Receive: TypeAlias = Callable[[Request], Answer | None]  # returns None where there is no answer, or not yet
NO_MOTOR: Final = "the daemon runs without a motor: set motor.port, or start it with --motor"
NO_PLANNER: Final = f"controller.sources.names lacks {PLANNER!r}: goals, paths and routes are off"
NO_MAP_FILE: Final = (
    "the robot keeps no map in a file: start its daemon with --map FILE.omap, or set places.map, "
    "without --localize-only"
)


class LiveCommands:
    """The receivers of commands, requests and samples; without a motor only samples and requests to save the map."""

    def __init__(
        self,
        session: Session,
        bus: Bus,
        controller: DriveLink | None,
        navigate: Callable[[NavigationCommand], None],
        report: Report,
        freshness: Freshness,
    ) -> None:
        """navigate: takes requests to the navigation. report: takes lines for the log, with a level of `logging`.

        freshness: the rule for the times of sending.
        """
        self._session, self._bus, self._controller = session, bus, controller
        settings, warn = session.config.controller, partial(report, logging.WARNING)
        bus.serve(TIME, freshness.own_time)
        self.navigation = NavigationReceiver(navigate, freshness, report=warn)
        self.commands: CommandReceiver | None = None
        if controller is not None:
            self.commands = CommandReceiver(
                controller, freshness, sources=settings.sources.names, is_unique=lambda: bus.is_unique, report=warn
            )
            controller.statistics.take_arm_answer = self._answer_arm

    def subscribe(self, sensors: SensorSources, saver: MapSaver | None) -> None:
        """Begin to receive."""
        sources = self._session.config.controller.sources.names
        topics = command_topics(sources) if self.commands else {**SENSOR_TOPICS, **MAP_TOPICS}
        table: dict[str, Receive] = {}
        if self.commands:
            navigate = self.navigation.receive if PLANNER in sources else _refusing(NO_PLANNER)
            table = {topic: self.commands.receive for topic in topics} | dict.fromkeys(NAVIGATION_TOPICS, navigate)
        table |= {
            topic: lambda request: sensors.receiver.receive(request.topic, request.payload) for topic in SENSOR_TOPICS
        }
        table[MAP] = _refusing(NO_MAP_FILE) if saver is None else saver.receive
        others = self.commands.receive if self.commands else _refusing(NO_MOTOR)  # counts unknown topics

        def receive(request: Request) -> None:
            answer = table.get(request.topic, others)(request)
            if answer is not None:
                self._bus.answer(request.id, answer)

        self._bus.subscribe_commands(receive, topics, self._is_stopped)

    def _is_stopped(self) -> bool:
        """True if a stop holds."""
        return self._controller is not None and self._controller.statistics.state.disarmed_by == DISARMED_BY_STOP

    def _answer_arm(self, answer: ArmAnswer) -> None:
        """Pass on the controller's answer; of several requests at once it answers the newest."""
        text = answer.refusal or "armed: it obeys commands from now on"
        if answer.refusal == AWAITED and self._controller is not None:
            text = f"{AWAITED}: {self._controller.statistics.state.problem}"
        if answer.refusal == NO_POSE:
            text = f"{NO_POSE}: {self._why_no_pose()}"
        self._bus.answer(answer.id, Answer(not answer.refusal, text), also_before=ARM)

    def _why_no_pose(self) -> str:
        """Return what is missing for the first pose."""
        if not self._session.graph.telemetry.of("pair").processed:
            return "no images have come from the cameras (`omnid listen`, `omnid doctor`)"
        return "the first images are being processed: try again in a moment (`omnid listen` tells what they show)"


def _refusing(reason: str) -> Receive:
    return lambda _: Answer(False, reason)


class LiveWiring:
    """Joins the parts of one run."""

    def __init__(self, session: Session, geometry: Geometry, robot: LiveRobot, report: Report) -> None:
        """Connect the wheels, the bus, the samples of wheels and gyro, and the recording."""
        config = session.config
        self._session, self._geometry, self._robot, self._report = session, geometry, robot, report
        self._latency, self._ladder = Latency(session.clock.monotonic_ns), LoadLadder()
        self._controller = robot.connect(session)
        self._bus = session.open_bus(geometry.rig, gives_time=robot.waits)
        self._pairing = Synchronise(geometry.rig, config.pair, config.motion.R_base_imu)
        self._sensors = SensorSources(
            config, self._pairing.motion, session.clock, self._controller, report, with_images=robot.brings_samples
        )
        self._recorder = self._open_recorder() if config.record.enabled else None
        self._rig = RigHealth(geometry.cylinder, config.rig.check, config.rig.check_s)
        self._front_end = FrontEnd(geometry, config, self._rig, load=self._load)

    def wire(self, run_places: RunPlaces) -> None:
        """Join the robot, stages, sinks and tickers."""
        session, robot = self._session, self._robot
        config, graph = session.config, session.graph
        # 1. From the cameras to pairs.
        frames = robot.sources(graph, self._pairing.motion.add)
        pairs = graph.stage("pair", self._pairing, *frames)
        area = UsefulArea(self._geometry.rig, self._geometry.cylinder)
        exposure = ExposureControl(area, config.cameras, robot.states())
        graph.sink("exposure", exposure, pairs, policy=NEWEST, depth=1)
        # 2. From pairs to poses, maps and setpoints.
        requests = RequestQueue()
        files = RouteFiles(RouteFolder(Path(config.navigation.routes)), requests.put, halts=self._halts)
        self._warn_of_unstated_height()
        parts = run_places.known_to(self._parts(requests, files))
        stages = wire(graph, pairs, self._front_end, config, self._sinks(frames), parts)
        if not robot.waits:
            graph.ticker("load", PERIOD_S, partial(self._ladder.observe, graph.telemetry.of("pair")))
        graph.bound("pair", "odometry")  # images that odometry has no time for are dropped before they are decoded
        # 3. Files of maps and routes.
        saver = self._saver(run_places, stages.places)
        if self._controller:
            graph.ticker("routes", files.PERIOD_S, files)
        if stages.places:
            files.save_map = stages.places.want_copy
        # 4. From the bus: commands, requests, samples.
        freshness = Freshness(
            config.controller.deadlines.command_s,
            *((RobotClock(), session.clock) if robot.waits else (session.clock,)),
        )
        received = LiveCommands(session, self._bus, self._controller, files.put, self._report, freshness)
        received.subscribe(self._sensors, saver)
        # 5. Status.
        self._add_status(stages, exposure, received, saver)

    def _load(self) -> LoadLevel:
        """Return the level of load shedding now."""
        return self._ladder.level

    def _halts(self) -> int:
        """Return how often a stop or a fault has made cmd/arm necessary."""
        return self._controller.statistics.state.halts if self._controller else 0

    def _parts(self, requests: RequestQueue, files: RouteFiles) -> RunParts:
        """Return the parts of a run that has no map yet."""
        controller = self._controller
        return RunParts(
            drive=LiveDrive(controller, self._geometry.rig.T_base_rig, requests.end) if controller else None,
            navigation=self._navigation(controller, requests, files) if controller else None,
            load=self._load,
            map_every_s=self._session.config.live.cloud_s,
            map_is_read=lambda: self._recorder is not None or self._bus.is_received("cloud"),
        )

    def _sinks(self, frames: list[Stream[Frame]]) -> Sinks:
        """Return the sinks; frames: the streams of the cameras, which a recording takes."""
        session, config, bus = self._session, self._session.config, self._bus
        poses: dict[str, Sink[OdometryUpdate]] = {}
        if config.bus.panorama_hz:
            poses["panorama"] = PanoramaSink(bus, config.bus.panorama_hz, session.clock.unix_ns)
        if self._rig.uses_views:
            poses["rig"] = RigViews(self._rig)
        recorder, controller = self._recorder, self._controller
        return Sinks(
            poses=poses,
            rings={"controller-ring": RingToController(controller)} if controller else {},
            counters={"statistics": session.statistics, "latency": self._latency},
            bus=BusSink(
                bus,
                session.encoder(self._geometry.rig, BUS_POINTS),
                clock=VelocityCommand if self._robot.waits else None,  # ticks of its wheels give the time
            ),
            recording=RecordingSink(recorder, tuple(frames), WAITING_RECORDS) if recorder else None,
        )

    def _add_status(
        self, stages: WiredStages, exposure: ExposureControl, received: LiveCommands, saver: MapSaver | None
    ) -> None:
        """Publish and record the status of all parts."""
        session, controller, sensors = self._session, self._controller, self._sensors
        warn, obstacles = partial(self._report, logging.WARNING), stages.obstacles
        fixed_share = (lambda: obstacles.fixed_share) if obstacles else (lambda: 0.0)
        images = ImagesStatus(self._geometry, session.statistics, warn, fixed_share)
        status = [
            self._ladder.status,
            images,
            exposure.status,
            partial(rig_status, self._rig),
            *([received.navigation.status] if controller else ()),
            partial(clock_status, session.clock),
            partial(motion_status, self._front_end.odometry, self._pairing.motion, sensors.receiver),
            *([partial(places_status, stages.places)] if stages.places else ()),
            *([partial(floor_status, stages.floor)] if stages.floor else ()),
            *self._robot.status,
            *(part.status for part in (self._bus, self._recorder, saver) if part),
        ]
        sources = StatusSources(
            session.graph.telemetry,
            self._robot.states(),
            self._pairing,
            session.statistics,
            self._latency.to_pose,
            controller.statistics if controller else None,
            received.commands,
            TICKERS,
            tuple(status),
            session.clock.monotonic_ns,
        )
        add_status_tickers(session, StatusCollector(sources), self._bus, self._recorder)

    def _warn_of_unstated_height(self) -> None:
        """Warn where the rig does not state its height: until the images show the floor, nothing is called free."""
        if self._geometry.rig.height_m(self._session.config.obstacles.ring.floor_m) is None:
            self._session.warn(
                "the rig states no height of the cameras: the floor is looked for in the images; "
                f"until it is found, map, grid and obstacles call nothing free; {ADVICE}"
            )

    def _saver(self, run_places: RunPlaces, places: Places | None) -> MapSaver | None:
        """Return what saves the map of places now and then; None where it stays as it is."""
        if places is None or not run_places.is_extended:
            return None
        saver = MapSaver(run_places, places, self._session.config.places.save_s, self._bus.answer)
        self._session.graph.ticker("save", saver.PERIOD_S, saver)
        return saver

    def _open_recorder(self) -> Recorder:
        session, rig = self._session, self._geometry.rig
        times = SegmentTime(session.clock)
        encode = session.encoder(rig, LOG_POINTS, times.unix_ns)
        recorder = open_recorder(session.config, rig_toml(rig), self._report, encode=encode, time=times)
        session.outputs.callback(recorder.close)
        return recorder

    def _navigation(self, controller: DriveLink, requests: RequestQueue, files: RouteFiles) -> NavigationParts | None:
        """Return the surroundings of the navigation; None, with a warning, where its source may not drive."""
        config = self._session.config
        if PLANNER not in config.controller.sources.names:
            self._session.warn(NO_PLANNER)
            return None
        return NavigationParts(
            requests,
            lambda: wheel_state(controller.statistics.state),
            PlannerDrive(controller, self._bus.answer, files),
            config.places.map,
        )
