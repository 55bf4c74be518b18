"""Live runs: a robot (cameras, motor, simulated or not), how a run joins stages, bus and wheels, and the run itself.

At the end: a run that only records, and the daemon as a systemd service (sd_notify(3)), with the line of a terminal.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from calib.rig import Rig
from calib.rig_file import read_rig, rig_toml
from drivers.cameras.camera_state import CameraState
from drivers.frame import CAMERAS, Camera, Frame, FrameSource
from drivers.logs.mcap_writer import RotatingLog
from drivers.motion import MotionSample
from omnid.config import Config
from omnid.controller.ipc import ARMED, ControllerStart
from omnid.controller.link import ControllerLink, DriveLink
from omnid.core.control.arming import MANUAL
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.rig.rig_health import RigHealth
from omnid.diagnostics.status import RunStatistics, StatusCollector, image_stats, rig_stats, wheel_stats
from omnid.engine.graph import Graph, StageStats, Stream
from omnid.engine.logging_setup import HANDLER, log
from omnid.engine.process import prepare, start_thread
from omnid.engine.robot_clock import RobotClock
from omnid.light.exposure import ExposureControl, UsefulArea
from omnid.plain_text import one_line
from omnid.runs.files import RunPlaces
from omnid.runs.wiring import BACKGROUND, BUS, Inputs, Leaving, Session, run_to_end, wire
from omnid.settings import dump
from omnid.sinks.encoder import BusSink, Encoder, PanoramaSink
from omnid.sinks.recorder import Recorder
from omnid.stages.front_end import FrontEnd
from omnid.stages.obstacles import FLOOR_WARNING
from omnid.transport import status_names as names
from omnid.transport import topics
from omnid.transport.codec import Diagnostics, compile_serialisers
from omnid.transport.commands import CommandReceiver, Freshness

RECORDED_DEPTH = 20  # messages of each kind that may wait for the disk of a live recording


class LiveCamera(FrameSource, Protocol):
    """A source of frames with a state for the status."""

    state: CameraState


class LiveRobot(Protocol):
    """A robot, or a simulated one, as a live run sees it."""

    waits: bool  # its time is stopped until the run has answered: nothing is dropped or omitted under load
    brings_samples: bool  # wheels and gyro come with the images, or not at all: no others fit them
    states: Mapping[Camera, CameraState]  # of the cameras, once they are open
    clock: RobotClock  # of the stamps of images, poses and ticks

    def connect(self, session: Session, /) -> tuple[Sequence[Stream[Frame | MotionSample]], DriveLink | None]:
        """Open the cameras and start the controller; return the sources of the images, and None without wheels.

        Outputs of the session close them.
        """


class ConnectedRobot:
    """Cameras, or the images of a log in their place, and a motor controller on a serial port, in real time."""

    waits = False

    def __init__(self, open_camera: Callable[[Camera], LiveCamera], *, plays_log: bool = False) -> None:
        """plays_log: the images are those of a log, and samples of wheels and gyro are not used."""
        self._open_camera, self.brings_samples = open_camera, plays_log
        self.states: Mapping[Camera, CameraState] = {}
        self.clock = RobotClock()

    def connect(self, session: Session) -> tuple[Sequence[Stream[Frame]], DriveLink | None]:
        """Open the cameras, and start the controller process where there is a motor; it waits for its answer.

        The wheels stop, and the process ends, at the latest with the outputs of the session. Raises DriverError for
        settings that it cannot use.
        """
        config, graph, outputs = session.config, session.graph, session.outputs
        cameras = {name: outputs.enter_context(closing(self._open_camera(name))) for name in CAMERAS}
        self.states = {name: camera.state for name, camera in cameras.items()}
        frames = [graph.source(name, camera.frames, wake=camera.close) for name, camera in cameras.items()]
        if not config.motor.port:
            return frames, None
        settings = config.controller if config.obstacles.enabled else config.controller.without_obstacles
        start = ControllerStart(config.motor, settings, config.realtime)
        link = ControllerLink(start, graph.counters("motor"), session.warn)
        outputs.callback(link.close)
        return frames, link


def run_live(config: Config, robot: LiveRobot, rig: Rig | None = None) -> None:
    """Run the daemon until a signal comes, or the cameras end. rig: None for that of the settings."""
    with suppress(OSError, ValueError):  # stderr is no file
        faulthandler.enable()  # the watchdog of systemd sends SIGABRT: the stacks of all threads are printed

    def warn(line: str) -> None:
        was_asked = line == ARMED or names.DISARMED_BY_STOP in line
        log(logging.INFO if was_asked else logging.WARNING, line)

    def begin(thread: str) -> None:
        if refused := start_thread(thread, config.realtime.capture_priority if thread in CAMERAS else 0):
            warn(refused)

    # Where the time of the robot waits for the stages nothing is dropped.
    graph = Graph(on_thread=begin) if robot.waits else Graph(drops=True, depth=1, on_thread=begin)
    with ExitStack() as outputs:
        session = Session(config, graph, outputs, warn, RunStatistics(robot.clock))
        # 1. The rig, and what is compiled or imported before the first image.
        geometry = session.geometry(rig or read_rig(Path(config.cameras.rig)), ())
        published = (topic.schema for topic in topics.PUBLISHED.values())
        compile_serialisers([*published, *(command.schema for command in topics.COMMANDS.values())])
        front_end = FrontEnd(geometry, config, RigHealth(geometry.cylinder, config.rig.check, config.rig.check_s))
        import_module("scipy.sparse.linalg")  # needed by the first loop closure
        outputs.enter_context(graph.signals())
        # 2. The connections, and the stages between them.
        run_places = _connect(session, front_end, robot)
        if geometry.rig.height_m(config.obstacles.scan.floor_m) is None:
            warn(FLOOR_WARNING)
        # 3. The status line of systemd and of a terminal.
        outputs.callback(HANDLER.show, "")
        outputs.callback(notify, "STOPPING=1", "STATUS=stopping")
        service = Service(graph.stats, session.statistics, config.service.stall_timeout_s)
        session.every(period_s(), service, "watchdog")
        # 4. The run, until a signal or a failure ends it.
        if sys.stderr.isatty():
            wheels = "`omnid arm` lets it drive; " if config.motor.port and config.controller.arming == MANUAL else ""
            endpoints = ", ".join(config.bus.connect if config.bus.is_client else config.bus.listen)
            log(logging.INFO, f"ready: poses at {endpoints} (`omnid listen`); {wheels}Ctrl-C ends")
        if not robot.waits:
            prepare()
        run_to_end(graph, run_places)


def _connect(session: Session, front_end: FrontEnd, robot: LiveRobot) -> RunPlaces:
    """Connect robot, bus and files, and wire the stages between them; return the map of places."""
    config, graph, clock, statistics = session.config, session.graph, robot.clock, session.statistics
    rig, health, motion = front_end.geometry.rig, front_end.health, front_end.pairing.motion

    # 1. Cameras and wheels, the bus, the map of places.
    frames, controller = robot.connect(session)
    bus = session.open_bus(rig, gives_time=robot.waits)
    run_places = RunPlaces(config, front_end.geometry, session.warn)

    # 2. The stages. Samples of gyro and wheels come from the bus, unless they come with the images of a log or of a
    #    simulation, whose motion others would not fit; a motor controller gives those of its wheels.
    used = {topics.IMU: config.motion.imu, topics.WHEEL_ODOM: config.motion.wheels}
    subscribed = {topic for topic, setting in used.items() if setting != "off" and not robot.brings_samples}
    samples = graph.inlet(1, thread="bus commands")
    graph.sink("samples", motion.add, samples, thread=samples.thread)
    requests = states = None
    if controller is not None and config.controller.collision.check and not config.obstacles.enabled:
        session.warn("obstacles.enabled = false: the collision monitor is off, nothing keeps the base from obstacles")
    if controller is not None:
        states = controller.statistics.states = graph.inlet(0, thread="drive")
        if topics.WHEEL_ODOM in subscribed:
            subscribed.discard(topics.WHEEL_ODOM)
            wheels = controller.statistics.wheels = graph.inlet(1, thread="drive")
            graph.sink("wheels", motion.add, wheels, thread=wheels.thread)
        requests = graph.inlet(topics.MAX_OPEN)
    saves = graph.inlet(topics.MAX_OPEN) if run_places.is_extended else None
    inputs = Inputs(frames, run_places, controller, requests, states, saves, config.live.cloud_s)
    streams = wire(config, inputs, front_end, graph)
    pairs, poses, reports = streams.pairs, streams.poses, graph.inlet(1)
    streams.leaving.append(Leaving("status", reports))

    # 3. The sinks.
    exposure = ExposureControl(UsefulArea(rig, front_end.geometry.cylinder), config.cameras, robot.states)
    graph.sink("statistics", statistics, poses, thread=poses.thread)
    graph.sink("exposure", exposure, pairs, thread=BACKGROUND)
    graph.sink(
        "rig",
        lambda pose: health.check_drive(pose.depth.panoramas, pose.T_odom_rig[:3, 3], pose.depth.exposure),
        poses,
        thread=BACKGROUND,
    )
    scan_range_m = config.obstacles.scan.max_range_m
    on_bus = Encoder(rig, scan_range_m, clock.unix_ns, names.RUN_ID)
    streams.publish(graph, BusSink(bus, on_bus, gives_time=robot.waits))
    if config.bus.panorama_hz:
        graph.sink("panorama", PanoramaSink(bus, config.bus.panorama_hz, clock.unix_ns), poses, thread=BACKGROUND)
    if config.record.enabled:
        in_files = Encoder(rig, scan_range_m, clock.segment_unix_ns)
        recorder = open_recorder(config, rig_toml(rig), clock, in_files)
        session.outputs.callback(recorder.close)
        session.parts[names.RECORDING] = recorder.stats
        images: Sequence[Stream[Any]] = [pairs] if config.record.images_hz else frames
        leaving = (one.stream for one in streams.leaving)
        graph.sink("record", recorder, *images, *leaving, depth=RECORDED_DEPTH)
    graph.sink("answer", bus.answer, *streams.answers, thread=BUS, depth=topics.MAX_OPEN)
    graph.connect()

    # 4. Commands, requests and samples from the bus.
    freshness = Freshness(config.controller.deadlines.command_s, *((RobotClock(), clock) if robot.waits else (clock,)))
    bus.serve(topics.TIME, freshness.own_time)
    commands = CommandReceiver(
        freshness, controller=controller, navigation=requests, saves=saves, samples=dict.fromkeys(subscribed, samples)
    )
    bus.subscribe_commands(
        commands.receive,
        lambda: controller is not None and controller.statistics.state.disarmed_by == names.DISARMED_BY_STOP,
    )

    # 5. The status of all parts.
    session.parts |= {
        names.MOTION: lambda: (
            front_end.motion_stats() | names.by_reason(names.REFUSED_PREFIX, commands.samples.refused)
        ),
        names.IMAGES: lambda: image_stats(statistics.newest),
        names.EXPOSURE: exposure.stats,
        names.RIG: partial(rig_stats, health),
    }
    if controller is not None:
        session.parts[names.WHEELS] = partial(wheel_stats, controller.statistics, commands)
    if streams.places is not None:
        session.parts[names.PLACES] = streams.places.stats
    if saves is not None:
        session.parts[names.MAP_FILE] = run_places.stats
    collect = StatusCollector(
        graph.stats, robot.states, front_end.pairing, statistics, session.parts, clock.monotonic_ns
    )
    session.every(
        config.live.status_s,
        lambda: reports.push(Diagnostics(clock.monotonic_ns(), tuple(collect()))),
        "status",
    )
    return run_places


def open_recorder(config: Config, rig: str, clock: RobotClock, encode: Encoder | None = None) -> Recorder:
    """Return a recorder to the folder of the configuration; the first message makes the first file.

    rig: the rig's TOML, or "" where there is none; it is attached to every file, as is the configuration.
    clock, encode: see Recorder; encode of the other messages of a run, whose images are thinned to record.images_hz;
    None: all images and nothing else are recorded.
    """
    attachments = {"omnid.toml": dump(config).encode()} | ({"rig.toml": rig.encode()} if rig else {})
    folder = Path(config.record.folder)
    files = RotatingLog(folder, config.bus.robot, config.record.rotation(), attachments, on_event=log)
    images_hz = config.record.images_hz if encode is not None else 0.0
    return Recorder(files, config.bus.robot, clock, encode, images_hz=images_hz)


def record_frames(sources: Mapping[Camera, FrameSource], config: Config, rig: str) -> Recorder:
    """Record frames with stamps of CLOCK_MONOTONIC until the sources end or a signal comes; return the recorder."""
    clock = RobotClock()
    graph = Graph(drops=True, depth=RECORDED_DEPTH)
    frames = [graph.source(name, source.frames, wake=source.close) for name, source in sources.items()]
    recorder = open_recorder(config, rig, clock)
    graph.sink("record", recorder, *frames)

    with closing(recorder), graph.signals():
        graph.run()
    state, dropped = recorder.state, graph.stats["record"].dropped
    written = state.messages - state.lost
    log(
        logging.INFO if written else logging.WARNING,
        f"recorded {written} messages in {state.files} files, lost {state.lost}, dropped {dropped}, "
        f"oldest files deleted {state.deleted}, {state.status}",
    )
    return recorder


def notify(*lines: str) -> None:
    """Send lines such as "READY=1" to systemd without waiting, if it started this process."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    destination = f"\0{address[1:]}" if address.startswith("@") else address
    kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC
    with suppress(OSError, ValueError), socket.socket(socket.AF_UNIX, kind) as sender:
        sender.sendto("\n".join(lines).encode(), socket.MSG_DONTWAIT, destination)


def period_s() -> float:
    """Return the time between two calls of a Service: a third of the watchdog's timeout, so that one may be late."""
    return min(1.0, float(os.environ.get("WATCHDOG_USEC", 3e6)) * 1e-6 / 3)


class Service:
    """Notifies systemd, each time that it is called, that the daemon is ready, of its status, and feeds the watchdog.

    The watchdog is fed as long as no stage works on one message for longer than a time; the first such stage is logged.
    A daemon that waits for images has no message in work.
    """

    def __init__(self, stages: Mapping[str, StageStats], statistics: RunStatistics, stall_timeout_s: float) -> None:
        """stages: counters of all. stall_timeout_s: longest time that a stage may work on one message."""
        self._stages, self._statistics = stages, statistics
        self._stall_ns, self._was_stalled, self._poses = stall_timeout_s / S_PER_NS, False, 0

    def __call__(self) -> None:
        """Notify systemd."""
        # 1. Stages that work on one message for too long.
        now_ns, found = time.monotonic_ns(), self._statistics
        busy = [(name, stage.busy_since_ns) for name, stage in self._stages.items()]
        stalled = [name for name, since_ns in busy if since_ns and now_ns - since_ns > self._stall_ns]
        if stalled and not self._was_stalled:
            log(logging.ERROR, f"stalled: {', '.join(stalled)}; the watchdog of systemd is no longer fed")
        self._was_stalled = bool(stalled)
        # 2. State, and what was lost.
        has_new, self._poses = found.poses > self._poses, found.poses
        state = found.newest.state if found.newest is not None and has_new else "waiting for images"
        dropped = sum(stage.dropped for stage in self._stages.values())
        line = f"{found.length_m:.2f} m, {state}, {dropped} messages dropped"
        line = f"stalled: {', '.join(stalled)}" if stalled else line
        HANDLER.show(line)
        notify("READY=1", *([] if stalled else ["WATCHDOG=1"]), f"STATUS={one_line(line)}")
