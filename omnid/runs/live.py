"""A live run: its robot (cameras, motor, simulated or not), its status for the service manager, and the run itself."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, closing, suppress
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Final, Protocol, TypeAlias

import cv2

from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.cameras.camera_state import CameraState
from drivers.frame import CAMERAS, Camera, Frame, FrameSource
from drivers.motion import MotionSample
from omnid.config import Config
from omnid.controller.link import DriveLink
from omnid.core.control.arming import MANUAL
from omnid.diagnostics.run_summary import RunStatistics
from omnid.diagnostics.status import StatusCollector, StatusTick
from omnid.engine.flow import nothing
from omnid.engine.graph import LOSSLESS, NEWEST, Graph, Stream
from omnid.engine.kernel_cache import prepare_kernels, read_kept_kernels
from omnid.engine.logging_setup import Report
from omnid.engine.realtime import ThreadStart, give_back_code, name_thread, prepare, priorities
from omnid.engine.robot_clock import RobotClock, fixed_offset, log_time
from omnid.engine.threads import started
from omnid.errors import OmnidError
from omnid.runs.sensor_sources import MotionSource
from omnid.runs.session import OPENCV_THREADS, TICKERS, Session
from omnid.runs.systemd import Service, StatusLine, print_stacks_when_killed
from omnid.sinks.encoder import status_report
from omnid.sinks.recorder import Recorder
from omnid.stages.geometry import Geometry
from omnid.transport.bus import Bus
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.status_names import with_remedy

StatusPublisher: TypeAlias = Callable[[list[DiagnosticStatus]], None]


def add_status_tickers(session: Session, status: StatusCollector, bus: Bus, recorder: Recorder | None) -> None:
    """Publish and record the status periodically, and report progress to the service manager."""
    config, graph = session.config, session.graph
    publishers = [_status_on_bus(bus)]
    if recorder is not None:
        publishers.append(lambda statuses: recorder.add(statuses, session.clock.monotonic_ns()))
    graph.ticker("status", config.live.status_s, StatusTick(status, *publishers))
    line = StatusLine(session.statistics, graph.telemetry, TICKERS)
    service = Service(graph.telemetry, line, config.service.stall_timeout_s)
    graph.ticker("watchdog", service.period_s, service)


def add_terminal_ticker(
    session: Session, show: Callable[[str], None], report: Report, words: Callable[[], str]
) -> None:
    """Show the status in one line of a terminal; show: rewrites that line, which ends with the words."""
    line = StatusLine(session.statistics, session.graph.telemetry, TICKERS)
    terminal = TerminalStatus(
        show, lambda: line() + words(), partial(report, logging.INFO), session.statistics, _ready(session.config)
    )
    session.graph.ticker("terminal", terminal.period_s, terminal)


def _ready(config: Config) -> str:
    """Return what to do now that the run is ready."""
    endpoints = ", ".join(config.bus.connect if config.bus.is_client else config.bus.listen)
    wheels = ""
    if not config.motor.port:
        wheels = "; no motor"
    elif config.controller.arming == MANUAL:
        wheels = "; the wheels turn after `omnid arm`"
    return f"ready: poses of {config.bus.robot!r} at {endpoints or 'no endpoint'} (`omnid listen`){wheels}; Ctrl-C ends"


def _status_on_bus(bus: Bus) -> StatusPublisher:
    """Return a function that publishes statuses; where the bus is slow, only the status ticker waits."""

    def publish(statuses: list[DiagnosticStatus]) -> None:
        with suppress(OmnidError):  # the system's clock may be set to a time that no message can hold
            message = status_report(time.time_ns(), [with_remedy(status) for status in statuses])
            bus.publish(message.topic, message.payload)

    return publish


class TerminalStatus:
    """The action of a ticker: shows a line as long as the run lasts."""

    period_s: Final = 0.5

    def __init__(
        self,
        show: Callable[[str], None],
        line: Callable[[], str],
        report: Callable[[str], None],
        statistics: RunStatistics,
        ready: str,
    ) -> None:
        """show: rewrites the line. line: its text. report: takes lines that stay. ready: of the start."""
        self._show, self._line, self._report = show, line, report
        self._statistics, self._ready = statistics, ready

    def __call__(self) -> None:
        """Report that the run is ready, once, and show the line."""
        if self._ready:
            self._report(self._ready)
            self._ready = ""
        self._show(f"{self._statistics.length_m:8.2f} m  {self._line()}")

    def close(self) -> None:
        """Remove the line, and report the summary."""
        self._show("")
        statistics = self._statistics
        states = ", ".join(f"{state} {count / statistics.poses:.1%}" for state, count in statistics.states.items())
        self._report(
            f"ended: {statistics.poses} poses, {statistics.length_m:.2f} m, {statistics.resets} resets"
            f"{f'; {states}' if states else ''}"
        )


MASK_FRAMES: Final = 60  # images of each camera in which the rim is searched, where the rig has no mask


class LiveCamera(FrameSource, Protocol):
    """A source of frames with a state for the status."""

    state: CameraState


OpenCamera: TypeAlias = Callable[[Camera], LiveCamera]  # called a second time after the first camera was closed


def first_frames(open_camera: OpenCamera) -> Generator[Frame, None, None]:
    """Yield the first frames of both cameras in turn; the cameras are open until this generator is closed."""
    with ExitStack() as cameras:
        streams = []
        for name in CAMERAS:
            camera = cameras.enter_context(closing(open_camera(name)))
            frames = iter(camera.frames())
            cameras.callback(getattr(frames, "close", nothing))  # a generator holds the device until it is closed
            streams.append(islice(frames, MASK_FRAMES))
        for pair in zip(*streams, strict=False):
            yield from pair


class LiveRobot(Protocol):
    """A robot, or a simulated one, as a live run sees it."""

    @property
    def waits(self) -> bool:
        """True if its time is stopped until the run has answered: nothing is dropped or omitted under load."""

    @property
    def brings_samples(self) -> bool:
        """True if wheels and gyro come with the images: no others fit them."""

    def clock_ns(self) -> int:
        """Return the time, by the clock of the stamps of images, poses and ticks [ns]."""

    def first_frames(self) -> Generator[Frame, None, None]:
        """Yield the first frames of both cameras in turn, for the rims of the mirrors."""

    def connect(self, session: Session) -> DriveLink | None:
        """Open the cameras and start the controller; None without wheels. Outputs of the session close them."""

    def sources(self, graph: Graph, take: Callable[[MotionSample], None]) -> list[Stream[Frame]]:
        """Add the sources of the images to a graph. take: takes the samples that come with them, from any thread."""

    def states(self) -> Mapping[Camera, CameraState]:
        """Return the states of the cameras."""

    def words(self) -> str:
        """Return what the line on a terminal ends with."""

    @property
    def status(self) -> tuple[Callable[[], DiagnosticStatus], ...]:
        """Functions that make the entries of the status that only this kind of robot has."""


class ConnectedRobot:
    """Cameras, or the images of a log in their place, and a motor controller on a serial port, in real time."""

    waits: Final = False

    def __init__(self, open_camera: OpenCamera, motion: MotionSource | None = None) -> None:
        """motion: wheels and gyro where the images are those of a log; None: those of the robot."""
        self._open_camera, self._motion = open_camera, motion
        self.brings_samples = motion is not None
        self._cameras: dict[Camera, LiveCamera] = {}

    def clock_ns(self) -> int:
        """Return CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def first_frames(self) -> Generator[Frame, None, None]:
        """Open the cameras for their first frames."""
        return first_frames(self._open_camera)

    def connect(self, session: Session) -> DriveLink | None:
        """Open the cameras, and start the controller process where there is a motor."""
        outputs: ExitStack = session.outputs
        self._cameras = {name: outputs.enter_context(closing(self._open_camera(name))) for name in CAMERAS}
        return session.start_controller(session.config.realtime) if session.config.motor.port else None

    def sources(self, graph: Graph, take: Callable[[MotionSample], None]) -> list[Stream[Frame]]:
        """Add the cameras, and the samples of a log."""
        if self._motion is not None:
            graph.source("motion", partial(map, take, self._motion.samples()), wake=self._motion.close)
        return [graph.source(name, camera.frames, wake=camera.close) for name, camera in self._cameras.items()]

    def states(self) -> Mapping[Camera, CameraState]:
        """Return the states of the cameras."""
        return {name: camera.state for name, camera in self._cameras.items()}

    def words(self) -> str:
        """Return nothing."""
        return ""

    @property
    def status(self) -> tuple[Callable[[], DiagnosticStatus], ...]:
        """Nothing: all its parts have entries of their own."""
        return ()


class LiveRun:
    """One run of the daemon."""

    def __init__(
        self,
        config: Config,
        robot: LiveRobot,
        report: Report,
        rig: Rig | None = None,
        show: Callable[[str], None] | None = None,
    ) -> None:
        """rig: None for that of the configuration. show: rewrites a line of the terminal; None without a terminal."""
        self._config, self._robot, self._report, self._rig, self._show = config, robot, report, rig, show
        self._graph = _graph_that_waits() if robot.waits else _graph_in_time(config, report)
        self._connected = False
        self.clock = log_time()  # that of the run, once it has begun

    def run(self) -> int:
        """Run until a signal comes, or the cameras end; return the exit code."""
        print_stacks_when_killed()
        loaded = started(_load, "imports")
        clock_ns, warn = self._robot.clock_ns, partial(self._report, logging.WARNING)
        self.clock = fixed_offset(clock_ns) if self._robot.waits else RobotClock(clock_ns, report=warn)
        with ExitStack() as outputs:
            session = Session(self._config, self._graph, outputs, warn, clock=self.clock)
            outputs.enter_context(session.signals(self._on_signal))
            geometry = self._geometry(session)
            loaded()
            from omnid.runs.live_wiring import LiveWiring
            from omnid.runs.place_maps import RunPlaces

            prepare_kernels()
            give_back_code("llvmlite")  # which has loaded the compiled functions, and does nothing else in a run
            self._connected = True
            run_places = RunPlaces(self._config, geometry, session.warn)
            LiveWiring(session, geometry, self._robot, self._report).wire(run_places)
            if self._show is not None:
                from omnid.runs.live import add_terminal_ticker

                add_terminal_ticker(session, self._show, self._report, self._robot.words)
            cv2.setNumThreads(OPENCV_THREADS)
            if not self._robot.waits:
                for refused in prepare(self._config.realtime):
                    session.warn(refused)
            started(_import_rarely_used, "imports")
            try:
                self._graph.run()
            except BaseException:
                with suppress(OmnidError):  # the error that ended the run is the one that is reported
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
        with closing(self._robot.first_frames()) as frames:
            return session.geometry(rig, frames)


def _graph_in_time(config: Config, report: Report) -> Graph:
    """Return a graph whose stages take the newest messages, in threads with the priorities of the settings."""
    return Graph(policy=NEWEST, depth=1, on_thread=ThreadStart(priorities(config.realtime, *CAMERAS), report))


def _graph_that_waits() -> Graph:
    """Return a graph that drops nothing, in threads as others are: the robot's time waits for it."""
    return Graph(policy=LOSSLESS, sinks_wait=True, on_thread=name_thread)


def _load() -> None:
    """Load what the stages need while images are awaited; what fails is loaded, and reported, where it is used."""
    for load in (partial(import_module, "omnid.runs.live_wiring"), _compile_serialisers, read_kept_kernels):
        with suppress(Exception):
            load()


def _compile_serialisers() -> None:
    from omnid.transport.codec import compile_serialisers
    from omnid.transport.topics import PUBLISHED, command_topics

    compile_serialisers({topic.schema for topic in PUBLISHED.values()} | set(command_topics(()).values()))


def _import_rarely_used() -> None:
    """Import what the first loop and the first goal need while the first poses are computed."""
    with suppress(Exception):
        for name in ("scipy.sparse.linalg", "scipy.spatial"):
            import_module(name)
