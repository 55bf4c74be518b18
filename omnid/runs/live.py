"""A live run: its robot (cameras, motor, simulated or not), how it joins stages, bus and wheels, and the run itself."""

from __future__ import annotations

import faulthandler
import logging
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final, Protocol, TypeAlias

from calib.rig import Rig
from calib.rig_file import read_rig, rig_toml
from drivers.cameras.camera_state import CameraState
from drivers.cameras.log_camera import LogMotion
from drivers.frame import CAMERAS, Camera, Frame, FrameSource
from drivers.motion import MotionSample
from drivers.motor import VelocityCommand
from omnid.config import Config
from omnid.controller.ipc import ARMED, ControllerState
from omnid.controller.link import DriveLink
from omnid.core.control.arming import MANUAL
from omnid.core.control.command_sources import SOURCES
from omnid.core.control.safety_rules import AWAITED
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.navigation.requests import NavigationCommand
from omnid.core.rig.rig_health import RigHealth
from omnid.diagnostics.status import StatusCollector, image_stats, rig_stats, wheel_stats
from omnid.engine.graph import Graph, Stream
from omnid.engine.kernel_cache import prepare_kernels
from omnid.engine.logging_setup import HANDLER, Report
from omnid.engine.process import prepare, start_thread
from omnid.engine.robot_clock import RobotClock, fixed_offset
from omnid.engine.telemetry import Histogram
from omnid.light.exposure import ExposureControl, UsefulArea
from omnid.messages import SaveMap
from omnid.runs.place_maps import RunPlaces
from omnid.runs.record import open_recorder
from omnid.runs.route_files import Requests
from omnid.runs.session import Session, run_to_end
from omnid.runs.systemd import Service, notify, period_s
from omnid.runs.wiring import Inputs, Navigation, Outputs, wire
from omnid.sinks.bus_sink import BusSink, PanoramaSink
from omnid.sinks.drive import PlannerDrive
from omnid.stages.front_end import FrontEnd
from omnid.stages.obstacles import ADVICE, controller_scan
from omnid.transport import status_names as names
from omnid.transport import topics
from omnid.transport.bus import Bus
from omnid.transport.codec import Diagnostics, compile_serialisers
from omnid.transport.commands import CommandReceiver, Freshness
from omnid.transport.sensor_codec import sample_from_cdr
from omnid.transport.topics import Answer, Request

NO_MOTOR: Final = "the daemon runs without a motor: set motor.port, or start it with --motor"
NO_SAMPLES: Final = "it is not used, see motion.wheels and motion.imu"
NO_MAP_FILE: Final = (
    "the robot keeps no map in a file: start its daemon with --map FILE.omap, or set places.map, "
    "without --localize-only"
)


class LiveCamera(FrameSource, Protocol):
    """A source of frames with a state for the status."""

    state: CameraState


OpenCamera: TypeAlias = Callable[[Camera], LiveCamera]


class LiveRobot(Protocol):
    """A robot, or a simulated one, as a live run sees it."""

    @property
    def waits(self) -> bool:
        """True if its time is stopped until the run has answered: nothing is dropped or omitted under load."""

    @property
    def brings_samples(self) -> bool:
        """True if wheels and gyro come with the images: no others fit them."""

    @property
    def states(self) -> Mapping[Camera, CameraState]:
        """The states of the cameras, once they are open."""

    def clock_ns(self) -> int:
        """Return the time, by the clock of the stamps of images, poses and ticks [ns]."""

    def connect(
        self, session: Session, take: Callable[[MotionSample], None]
    ) -> tuple[list[Stream[Frame]], DriveLink | None]:
        """Open the cameras and start the controller; return the sources of the images, and None without wheels.

        Outputs of the session close them. take: takes the samples that come with the images, from any thread.
        """

    def stats(self) -> dict[str, Any]:
        """Return the numbers that only this kind of robot has."""


class ConnectedRobot:
    """Cameras, or the images of a log in their place, and a motor controller on a serial port, in real time."""

    waits: Final = False

    def __init__(self, open_camera: OpenCamera, open_motion: Callable[[], LogMotion] | None = None) -> None:
        """open_motion: of wheels and gyro where the images are those of a log, called when the cameras were opened for
        the run; None: those of the robot.
        """
        self._open_camera, self._open_motion = open_camera, open_motion
        self.brings_samples = open_motion is not None
        self.states: dict[Camera, CameraState] = {}

    def clock_ns(self) -> int:
        """Return CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def connect(
        self, session: Session, take: Callable[[MotionSample], None]
    ) -> tuple[list[Stream[Frame]], DriveLink | None]:
        """Open the cameras, and start the controller process where there is a motor."""
        graph, outputs = session.graph, session.outputs
        cameras = {name: outputs.enter_context(closing(self._open_camera(name))) for name in CAMERAS}
        self.states = {name: camera.state for name, camera in cameras.items()}
        if self._open_motion is not None:
            motion = self._open_motion()
            graph.source("motion", partial(map, take, motion.samples()), wake=motion.close)
        frames = [graph.source(name, camera.frames, wake=camera.close) for name, camera in cameras.items()]
        return frames, session.start_controller(session.config.realtime) if session.config.motor.port else None

    def stats(self) -> dict[str, Any]:
        """Return none: all its parts have entries of their own."""
        return {}


def run_live(config: Config, robot: LiveRobot, report: Report, rig: Rig | None = None) -> RobotClock:
    """Run the daemon until a signal comes, or the cameras end; return its clock. rig: None for that of the settings."""
    with suppress(OSError, ValueError):  # stderr is no file
        faulthandler.enable()  # the watchdog of systemd sends SIGABRT: the stacks of all threads are printed

    def warn(line: str) -> None:
        was_asked = line == ARMED or names.DISARMED_BY_STOP in line
        report(logging.INFO if was_asked else logging.WARNING, line)

    if robot.waits:  # its time waits for the stages, so that nothing is dropped
        graph, clock = Graph(on_thread=partial(start_thread, {}, report)), fixed_offset(robot.clock_ns)
    else:
        priorities: dict[str, int] = dict.fromkeys(CAMERAS, config.realtime.capture_priority)
        graph = Graph(drops=True, depth=1, on_thread=partial(start_thread, priorities, report))
        clock = RobotClock(robot.clock_ns, report=warn)
    with ExitStack() as outputs:
        session = Session(config, graph, outputs, warn, clock)
        # 1. The rig, and what is compiled or imported before the first image.
        geometry = session.geometry(rig or read_rig(Path(config.cameras.rig)), ())
        compile_serialisers(
            [*(topic.schema for topic in topics.PUBLISHED.values()), *topics.command_topics(()).values()]
        )
        prepare_kernels()
        import_module("scipy.sparse.linalg")  # what the first loop needs
        outputs.enter_context(graph.signals())
        # 2. The connections, and the stages between them.
        health = RigHealth(geometry.cylinder, config.rig.check, config.rig.check_s)
        run_places = _join(session, FrontEnd(geometry, config, health), robot, report)
        # 3. The status line of systemd and of a terminal.
        outputs.callback(HANDLER.show, "")
        outputs.callback(notify, "STOPPING=1", "STATUS=stopping")
        service = Service(graph.telemetry, session.statistics, config.service.stall_timeout_s, HANDLER.show)
        session.every(period_s(), service, "watchdog")
        # 4. The run, until a signal or a failure ends it.
        if sys.stderr.isatty():
            wheels = "`omnid arm` lets it drive; " if config.motor.port and config.controller.arming == MANUAL else ""
            endpoints = ", ".join(config.bus.connect if config.bus.is_client else config.bus.listen)
            report(logging.INFO, f"ready: poses at {endpoints} (`omnid listen`); {wheels}Ctrl-C ends")
        if not robot.waits and (refused := prepare(config.realtime)):
            warn(refused)
        run_to_end(graph, run_places)
    return clock


def _join(session: Session, front_end: FrontEnd, robot: LiveRobot, report: Report) -> RunPlaces:
    """Connect robot, bus and files, and wire the stages between them; return the map of places."""
    config, graph, clock, statistics = session.config, session.graph, session.clock, session.statistics
    geometry, health, motion = front_end.geometry, front_end.health, front_end.pairing.motion
    rig = geometry.rig

    # 1. What is outside: cameras and wheels, the bus, the recording.
    frames, controller = robot.connect(session, motion.add)
    bus = session.open_bus(rig, gives_time=robot.waits)
    recorder = None
    if config.record.enabled:
        encode = session.encoder(rig, clock.segment_unix_ns)
        recorder = open_recorder(config, rig_toml(rig), report, clock, encode, config.record.images_hz)
        session.outputs.callback(recorder.close)

    # 2. Who takes what the stages make.
    to_pose, reports = Histogram(), graph.inlet(1)  # time from the images to their pose [s], and the status
    exposure = ExposureControl(UsefulArea(rig, geometry.cylinder), config.cameras, robot.states)
    outputs = Outputs(
        pairs={"exposure": exposure},
        counters={
            "statistics": statistics,
            "latency": lambda pose: to_pose.add((clock.monotonic_ns() - pose.stamp_ns) * S_PER_NS),
        },
        # The ticks of wheels that wait give the time.
        bus=BusSink(bus, session.encoder(rig), clock=VelocityCommand if robot.waits else None),
        recorder=recorder,
        records_images=True,
        reports=reports,
    )
    if config.bus.panorama_hz:
        outputs.poses["panorama"] = PanoramaSink(bus, config.bus.panorama_hz, clock.unix_ns)
    if health.uses_views:
        outputs.poses["rig"] = lambda pose: health.drive(
            pose.depth.panoramas, pose.T_odom_rig[:3, 3], pose.depth.exposure
        )

    # 3. The stages, and the navigation with its requests and files.
    requests = Requests(graph)
    if rig.height_m(config.obstacles.scan.floor_m) is None:
        session.warn(
            "the rig states no height of the cameras: the floor is looked for in the images; "
            f"until it is found, map, grid and obstacles call nothing free; {ADVICE}"
        )
    run_places = RunPlaces(config, geometry, session.warn, graph.inlet(topics.MOST_OPEN), bus.answer)
    navigation = None
    if controller is not None:
        outputs.scans["controller-scan"] = lambda scan: controller.send(controller_scan(scan))
        states = controller.statistics.states = graph.inlet(1, thread="drive")
        graph.sink("arming", partial(_answer_arming, bus), states, thread=states.thread)
        if config.motion.wheels != "off" and not robot.brings_samples:
            wheels = controller.statistics.wheels = graph.inlet(1, thread="drive")
            graph.sink("wheels", motion.add, wheels, thread=wheels.thread)
        navigation = Navigation(requests, states, PlannerDrive(controller, bus.answer), bus.answer)
    inputs = Inputs(frames, run_places, controller, navigation, config.live.cloud_s)
    stages = wire(config, inputs, front_end, graph, outputs)

    # 4. What comes from the bus: samples of gyro and wheels, unless they come with the images of a log or of a
    #    simulation, whose motion others would not fit; a motor controller gives those of its wheels. Commands and
    #    requests; without a motor all but those to save the map are refused.
    used = {
        topics.IMU: config.motion.imu != "off",
        topics.WHEEL_ODOM: config.motion.wheels != "off" and controller is None,
    }

    def add_sample(topic: str, payload: bytes) -> None:
        motion.add(sample_from_cdr(payload, topics.command_of(topic).schema, clock.stamp_ns))

    sensors = {topic: partial(add_sample, topic) for topic in used if used[topic] and not robot.brings_samples}
    freshness = Freshness(config.controller.deadlines.command_s, *((RobotClock(), clock) if robot.waits else (clock,)))
    bus.serve(topics.TIME, freshness.own_time)

    def ask(command: NavigationCommand) -> None:
        requests.put(command._replace(stop_count=controller.statistics.state.stop_count if controller else 0))

    taken, saves = topics.command_topics(SOURCES), run_places.requests
    why_not = {} if controller else dict.fromkeys(taken, NO_MOTOR)
    why_not |= {topics.MAP: NO_MAP_FILE, **dict.fromkeys(topics.SENSOR_TOPICS, NO_SAMPLES)}
    commands = CommandReceiver(
        freshness,
        controller=controller,
        sources=SOURCES,
        is_unique=lambda: bus.is_unique,
        navigate=ask if controller is not None else None,
        save_map=(lambda id: saves[0].push(SaveMap(id))) if saves else None,
        sensors=sensors,
        why_not=why_not,
        report=session.warn,
    )

    def receive(request: Request) -> None:
        if (answer := commands.receive(request)) is not None:
            bus.answer(request.id, answer)

    def is_stopped() -> bool:
        return controller is not None and controller.statistics.state.disarmed_by == names.DISARMED_BY_STOP

    bus.subscribe_commands(receive, taken, is_stopped)

    # 5. The status of all parts.
    parts: dict[str, Callable[[], names.Stats] | None] = {
        names.MOTION: lambda: (
            front_end.motion_stats() | names.by_reason(names.REFUSED_PREFIX, commands.samples.refused)
        ),
        names.WHEELS: partial(wheel_stats, controller.statistics, commands) if controller else None,
        names.REQUESTS: commands.requests.stats if controller else None,
        names.IMAGES: lambda: image_stats(statistics.newest),
        names.EXPOSURE: exposure.stats,
        names.RIG: partial(rig_stats, health),
        names.CLOCK: clock.stats,
        names.BUS: bus.stats,
        names.PLACES: stages.places.stats if stages.places else None,
        names.FLOOR: stages.floor.stats if stages.floor else None,
        names.RECORDING: recorder.stats if recorder else None,
        names.MAP_FILE: run_places.stats if saves else None,
        names.SIMULATION: robot.stats if robot.stats() else None,
    }
    watched = {name: stats for name, stats in parts.items() if stats is not None}
    collect = StatusCollector(
        graph.telemetry, robot.states, front_end.pairing, statistics, to_pose, watched, clock.monotonic_ns
    )

    def give_status() -> None:
        reports.push(Diagnostics(clock.monotonic_ns(), tuple(collect())))

    session.every(config.live.status_s, give_status, "status")
    return run_places


def _answer_arming(bus: Bus, state: ControllerState) -> None:
    """Answer the newest request to arm, and those before it, which happens once."""
    answer = state.arm_answer
    text = answer.refusal or "armed: it obeys commands from now on"
    if answer.refusal == AWAITED:
        text = f"{AWAITED}: {state.problem}"
    bus.answer(answer.id, Answer(not answer.refusal, text), also_before=topics.ARM)
