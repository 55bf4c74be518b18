"""A run on the robot itself: two cameras, the stages, the wheels, the bus, until it is told to end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from itertools import chain, islice
from pathlib import Path
from types import FrameType
from typing import Protocol

from calib.rig import Rig
from calib.rig_file import read_rig, rig_toml
from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera, Frame, FrameSource
from omnid.config import Config
from omnid.controller.controller import ControllerSettings
from omnid.controller.link import ControllerLink
from omnid.controller.messages import ControllerStart
from omnid.diagnostics.latency import Latency
from omnid.diagnostics.rig_monitor import RigMonitor
from omnid.diagnostics.run_statistics import RunStatistics
from omnid.diagnostics.status import StatusReport, StatusSources, StatusTick
from omnid.engine.flow import nothing
from omnid.engine.graph import NEWEST, Graph, Sink
from omnid.engine.logging_setup import WARNING
from omnid.engine.realtime import ThreadStart, prepare, priorities
from omnid.engine.signals import ended_by_signals
from omnid.engine.telemetry import StageStats
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.runs.pipeline import Sinks, wire
from omnid.runs.record import open_recorder
from omnid.runs.systemd import Service, StatusLine, show_stacks_at_the_end
from omnid.settings import dump
from omnid.sinks.bus_sink import BusSink, PanoramaSink
from omnid.sinks.command_log import keeper_of_commands
from omnid.sinks.encoder import Encoder, clouds_of, status_report
from omnid.sinks.frame_recorder import FrameRecorder
from omnid.stages.geometry import Geometry, geometry, with_rims
from omnid.stages.synchronise import Synchronise
from omnid.transport.bus import Bus
from omnid.transport.codec import DiagnosticStatus, compile_serialisers
from omnid.transport.commands import CommandReceiver

CAMERAS: tuple[Camera, ...] = ("lower", "upper")
LOOKS = 60  # images of either camera in which the rim is looked for, where the rig has no mask
TICKERS = frozenset({"motor", "status", "watchdog", "router"})
Say = Callable[[int, str], None]  # severity as syslog has it, and one line


class LiveCamera(FrameSource, Protocol):
    """A source of frames that tells how it is."""

    state: CameraState


Opener = Callable[[Camera], LiveCamera]  # may be asked twice for a camera, once the first has been closed


class LiveRun:
    """One run of the daemon; rig: None for that of the configuration."""

    def __init__(self, config: Config, open_camera: Opener, say: Say, rig: Rig | None = None) -> None:
        self._config, self._open, self._say, self._rig = config, open_camera, say, rig
        on_thread = ThreadStart(priorities(config.realtime, *CAMERAS), say)
        self._graph = Graph(policy=NEWEST, depth=1, on_thread=on_thread)
        self._tally, self._latency = RunStatistics(), Latency()
        self.offset_ns = time.time_ns() - time.monotonic_ns()  # from the stamps in here to Unix time
        self._running = False

    def run(self) -> int:
        """The exit code, 0 after a signal to end."""
        show_stacks_at_the_end()
        compile_serialisers()
        with ended_by_signals(self._on_signal), ExitStack() as ends:
            place = self._geometry()
            self._running = True
            self._wire(place, {name: ends.enter_context(closing(self._open(name))) for name in CAMERAS}, ends)
            for refused in prepare(self._config.realtime, self._config.graph.opencv_threads):
                self._say(WARNING, refused)
            self._graph.run()
        return 0

    def _geometry(self) -> Geometry:
        """The rig; the mirrors' rims are looked for in the first images where it has no masks."""
        rig = self._rig or read_rig(Path(self._config.cameras.rig))
        if rig.lower.mask is None or rig.upper.mask is None:
            with ExitStack() as ends:
                rig = with_rims(rig, chain.from_iterable(zip(*self._first_images(ends), strict=False)))
            self._tell_of_rims(rig)
        return geometry(rig, self._config.panorama)

    def _first_images(self, ends: ExitStack) -> Iterator[Iterator[Frame]]:
        for name in CAMERAS:
            camera = ends.enter_context(closing(self._open(name)))
            images = iter(camera.frames())
            ends.callback(getattr(images, "close", nothing))  # a generator holds the device until it is closed
            yield islice(images, LOOKS)

    def _tell_of_rims(self, rig: Rig) -> None:
        for name, camera in (("lower", rig.lower), ("upper", rig.upper)):
            if camera.mask is None:
                self._say(WARNING, f"no rim was found in the first images of the {name} camera, so all of each "
                          f"image is used: the rig may say otherwise in [{name}.mask]")

    def _wire(self, place: Geometry, cameras: Mapping[Camera, LiveCamera], ends: ExitStack) -> None:
        config, graph = self._config, self._graph
        helm = self._helm(place, ends) if config.motor.port else None
        bus = self._bus(place, ends)
        pair = Synchronise(place.rig, config.pair)
        frames = [graph.source(name, camera.frames, wake=camera.close) for name, camera in cameras.items()]
        recorder = self._recorder(place, ends) if config.record.enabled else None
        poses: dict[str, Sink[OdometryUpdate]] = {"tally": self._tally, "latency": self._latency}
        if config.bus.panorama_hz:
            poses["panorama"] = PanoramaSink(bus, config.bus.panorama_hz, self.offset_ns)
        watch = RigMonitor(place.cylinder, config.live.check_s) if config.live.check_s else None
        sinks = Sinks(poses=poses, bus=BusSink(bus, self._encoder(place, config.live.cloud_points)), helm=helm,
                     rig=watch, map_every_s=config.live.cloud_s, recorder=recorder, images=tuple(frames),
                     record_depth=config.record.queue)
        wire(graph, graph.stage("pair", pair, *frames), place, config, sinks)
        commands = self._commands(bus, helm, recorder) if helm else None
        report = StatusReport(
            StatusSources(
                graph.telemetry,
                {name: camera.state for name, camera in cameras.items()},
                pair,
                self._tally,
                self._latency.to_pose,
                helm.logbook if helm else None,
                commands,
                TICKERS,
                tuple(part.status for part in (bus, recorder, watch) if part),
            )
        )
        wants = [self._publisher(bus), *([] if recorder is None else [_keeper(recorder, self.offset_ns)])]
        graph.ticker("status", config.live.status_s, StatusTick(report, *wants))
        service = Service(graph.telemetry, StatusLine(self._tally, graph.telemetry, TICKERS), config.service.hung_s)
        graph.ticker("watchdog", service.period_s, service)

    def _bus(self, place: Geometry, ends: ExitStack) -> Bus:
        """The bus, on which whoever asks is told how this robot is set."""
        bus = Bus(self._config.bus)
        ends.callback(bus.close)
        bus.serve("config", dump(self._config))
        bus.serve("rig", rig_toml(place.rig))
        if bus.needs_router:
            self._graph.ticker("router", self._config.bus.retry_s, bus.connect)
        return bus

    def _helm(self, place: Geometry, ends: ExitStack) -> ControllerLink:
        config = self._config
        settings = ControllerSettings(1.0 / config.motor.rate_hz, config.helm.deadlines, config.guidance.limits,
                                config.helm.limits)
        helm = ControllerLink(ControllerStart(config.motor, settings, config.realtime), place.rig.T_base_rig,
                        self._graph.telemetry.add(StageStats("motor")), lambda text: self._say(WARNING, text))
        ends.callback(helm.close)
        return helm

    def _recorder(self, place: Geometry, ends: ExitStack) -> FrameRecorder:
        encode = self._encoder(place, self._config.record.cloud_points)
        recorder = open_recorder(self._config, rig_toml(place.rig), self._say, encode=encode, offset_ns=self.offset_ns)
        ends.callback(recorder.close)
        return recorder

    def _encoder(self, place: Geometry, points: int) -> Encoder:
        return Encoder(place.rig.T_base_rig, clouds_of(self._config, points), self.offset_ns)

    def _commands(self, bus: Bus, helm: ControllerLink, recorder: FrameRecorder | None) -> CommandReceiver:
        commands = CommandReceiver(helm.command, helm.stop, self._config.helm.deadlines.command_s)
        keep = nothing if recorder is None else keeper_of_commands(recorder, self.offset_ns)

        def take(key: str, payload: bytes) -> None:
            commands.receive(key, payload)  # first: a stop waits for nothing
            keep(key, payload)

        bus.subscribe_commands(take)
        return commands

    def _publisher(self, bus: Bus) -> Callable[[list[DiagnosticStatus]], None]:
        """What publishes statuses; the bus may be slow, and only the ticker waits for it."""

        def publish(statuses: list[DiagnosticStatus]) -> None:
            with suppress(OmnidError):  # the next one comes in a second; a clock may be set to what is no time
                said = status_report(time.time_ns(), statuses)
                bus.publish(said.topic, said.payload)

        return publish

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        """The first signal ends the run: the wheels slow down, what waits is finished. A second one ends it at once.

        From where connections are opened on, it only makes a note, by which the run ends as soon as it begins: an
        exception in the midst of that would leave open what keeps Python from ending.
        """
        self._graph.stop()
        if not self._running:
            raise SystemExit(0)  # the first images are waited for; the cameras are closed on the way


def _keeper(recorder: FrameRecorder, offset_ns: int) -> Callable[[list[DiagnosticStatus]], None]:
    """What records statuses."""

    def keep(statuses: list[DiagnosticStatus]) -> None:
        now_ns = time.monotonic_ns() + offset_ns  # as the stamps of all else, also when the clock has been set
        with suppress(OmnidError):  # a clock may be set to what is no time
            recorder.add(status_report(now_ns, statuses), now_ns)

    return keep
