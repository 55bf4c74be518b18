"""A run over a recorded log, from the opening of its files to the summary."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TypeAlias

import cv2

from calib.rig_file import read_rig, rig_toml
from drivers.errors import DriverError
from drivers.frame import Frame
from drivers.logs.mcap_reader import LogReader
from drivers.motors.simulated.simulated_motor import SimulatedMotor
from omnid.config import Config
from omnid.controller.motor import MotorTick, open_motor
from omnid.diagnostics.input_warnings import input_warnings, no_pose
from omnid.diagnostics.progress import Progress
from omnid.diagnostics.run_statistics import RunStatistics
from omnid.diagnostics.run_summary import QUIET_BOXES, counters, run_summary
from omnid.diagnostics.status import stage_status
from omnid.engine.graph import LOSSLESS, NEWEST, Graph, Sink, Stream
from omnid.engine.playback_clock import PlaybackClock
from omnid.engine.signals import ended_by_signals
from omnid.engine.telemetry import Telemetry
from omnid.errors import OmnidError
from omnid.runs.log_rig import attached_rig
from omnid.runs.pipeline import Sinks, WiredStages, wire
from omnid.settings import dump
from omnid.sinks.bus_sink import BusSink
from omnid.sinks.encoder import Encoder, Outgoing, clouds_of
from omnid.sinks.files import MapFile, PlanFile, TrajectoryFile, check_outputs, on_stdout
from omnid.sinks.recorder import Recorder
from omnid.stages.geometry import Geometry, geometry, with_rims
from omnid.stages.synchronise import Synchronise
from omnid.transport.bus import Bus
from omnid.transport.codec import OK, DiagnosticStatus

Topics: TypeAlias = tuple[str | None, str | None]  # of the lower and the upper camera
TICKERS = ("progress", "motor", "router")  # what they drop are deadlines, not messages
Watch: TypeAlias = Callable[[Geometry, Telemetry], Sink[Outgoing]]
READER_DROPS = ("late", "duplicate", "broken", "broken_records")


@dataclass(frozen=True, slots=True)
class Options:
    """What is wanted of a run."""

    tum: Path | None = None
    map: Path | None = None
    plan: Path | None = None
    record: Path | None = None
    publish: bool = False
    bus_optional: bool = False  # without a bus, go on without
    inline: bool = False
    realtime: bool = False
    quiet: bool = False
    settings: Path | None = None  # where the configuration was read, so that nothing is written over it
    watch: Watch | None = None  # makes one who is told everything, in the place of a recorder
    map_every_s: float = 0.0  # between two maps, by the stamps; 0: one, at the end

    @property
    def files(self) -> list[tuple[str, Path]]:
        """The files that will be written, by option."""
        named = (("--tum", self.tum), ("--map", self.map), ("--plan", self.plan), ("--record", self.record))
        return [(name, path) for name, path in named if path is not None]


class ReplayRun:
    """One run over one log."""

    def __init__(self, log: Path, config: Config, options: Options) -> None:
        self._log, self._config, self._options = log, config, options
        self._graph = Graph(policy=NEWEST if options.realtime else LOSSLESS, threaded=not options.inline,
                            depth=config.graph.depth)
        self._tally = RunStatistics()
        self._twin: SimulatedMotor | None = None
        self._signal = 0
        self._warnings: list[str] = []

    def run(self, rig: Path | None, topics: Topics) -> int:
        """The exit code, 1 where not one pose was found; prints warnings and the summary."""
        check_outputs(self._options.files, self._inputs(rig))
        cv2.setNumThreads(self._config.graph.opencv_threads)
        with ExitStack() as closing:
            reader = self._reader(rig, topics)
            closing.callback(reader.close)
            place = self._geometry(reader, rig)
            ends = self._ends(place, closing)
            pair = Synchronise(place.rig, self._config.pair)
            pairs = self._graph.stage("pair", pair, self._frames(reader))
            watched = wire(self._graph, pairs, place, self._config, ends)
            if isinstance(ends.recorder, Recorder):
                ends.recorder.report = lambda tally: self._report(counters(tally, self._dropped(reader, pair)))
            self._show_progress(reader)
            try:
                with ended_by_signals(self._on_signal):
                    self._graph.run()
            except (OmnidError, DriverError):
                if self._tally.poses:  # what there was until then is whole
                    self._conclude(reader, pair, watched)
                raise
            self._conclude(reader, pair, watched)
        return 128 + self._signal if self._signal else int(no_pose(self._tally))

    def _inputs(self, rig: Path | None) -> list[tuple[str, Path]]:
        """The files that are read, each with its name for errors."""
        named = (("the log that is read", self._log), ("the rig that is read", rig),
                 ("the configuration that is read", self._options.settings))
        in_folder = [("the log that is read", log) for log in sorted(self._log.glob("*.mcap"))]
        return [(what, path) for what, path in named if path is not None] + in_folder

    def _reader(self, rig: Path | None, topics: Topics) -> LogReader:
        """The log; which camera is which say the options, else the rig's topics, else the topics' own names."""
        window = self._config.log.reorder_frames
        named = read_rig(rig).topics if rig and not all(topics) else ("", "")
        if all(named):
            with suppress(DriverError):  # the log's topics may have other names than when the rig was calibrated
                return LogReader(self._log, topics[0] or named[0], topics[1] or named[1], window=window)
        return LogReader(self._log, *topics, window=window)

    def _geometry(self, reader: LogReader, path: Path | None) -> Geometry:
        rig = read_rig(path) if path else attached_rig(reader, self._log)
        rimmed = with_rims(rig, reader.frames())
        for name, camera in (("lower", rimmed.lower), ("upper", rimmed.upper)):
            if camera.mask is None:
                self._warnings.append(f"no rim was found in the first images of the {name} camera, so all of each "
                                      f"image is used: the rig may say otherwise in [{name}.mask]")
        return geometry(rimmed, self._config.panorama)

    def _frames(self, reader: LogReader) -> Stream[Frame]:
        if not self._options.realtime:
            return self._graph.source("read", reader.frames)
        pace = PlaybackClock()
        return self._graph.source("read", lambda: pace.frames(reader.frames()), wake=pace.wake)

    def _ends(self, place: Geometry, closing: ExitStack) -> Sinks:
        """Opens all outputs: what cannot be opened is said now."""
        options, config = self._options, self._config
        encode = Encoder(place.rig.T_base_rig, clouds_of(config, config.record.cloud_points))
        motor = None
        recorder = options.watch(place, self._graph.telemetry) if options.watch else None
        bus = self._bus(encode, closing) if options.publish else None
        if config.motor.port:
            driver, self._twin = open_motor(config.motor, closing)
            motor = MotorTick(driver, config.motor.stale_s)
        if options.record:
            attachments = {"rig.toml": rig_toml(place.rig).encode(), "omnid.toml": dump(config).encode()}
            recorder = Recorder(options.record, attachments, config.bus.robot, encode)
            closing.callback(recorder.close)
        ends = Sinks({"tally": self._tally}, {}, recorder, bus, motor, map_every_s=options.map_every_s)
        if options.tum:
            ends.poses["trajectory"] = TrajectoryFile(options.tum)
        if options.map:
            ends.maps["map"] = MapFile(options.map)
        if options.plan:
            ends.maps["plan"] = PlanFile(options.plan)
        return ends

    def _bus(self, encode: Encoder, closing: ExitStack) -> BusSink | None:
        try:
            bus = Bus(self._config.bus)
        except OmnidError as error:
            if not self._options.bus_optional:
                raise
            print(f"omnid: warning: going on without a bus: {error}", file=sys.stderr)
            return None
        closing.callback(bus.close)
        bus.serve("config", dump(self._config))
        if bus.needs_router:
            self._graph.ticker("router", self._config.bus.retry_s, bus.connect)
        return BusSink(bus, encode)

    def _show_progress(self, reader: LogReader) -> None:
        if not self._options.quiet:
            progress = Progress(self._tally, reader.pair_estimate())
            self._graph.ticker("progress", progress.period_s, progress)

    def _conclude(self, reader: LogReader, pair: Synchronise, watched: WiredStages) -> None:
        found = self._tally.poses or not self._signal
        doubtful = input_warnings(pair, watched.stereo, self._tally, self._config.pair) if found else ()
        for warning in [*self._warnings, *reader.warnings, *doubtful]:
            print(f"omnid: warning: {warning}", file=sys.stderr)
        values = {"pairs": str(pair.counts["pairs"]), **counters(self._tally, self._dropped(reader, pair))}
        if watched.mapping is not None:
            values["map"] = ", ".join(f"{name} {count}" for name, count in watched.mapping.counts.items())
        if self._twin is not None:
            values["motor"] = f"{self._twin.commands} commands received, {self._twin.errors} errors"
        spoken = sys.stderr if on_stdout(self._options.files) else sys.stdout
        print(run_summary(values, self._graph.telemetry.summary()), file=spoken)

    def _report(self, values: dict[str, str]) -> list[DiagnosticStatus]:
        """The counts of the run and of its stages, for the log."""
        boxes = (stats for stats in self._graph.telemetry.stages if stats.name not in QUIET_BOXES)
        return [DiagnosticStatus("omnid: summary", OK, "the run has ended", values), *map(stage_status, boxes)]

    def _dropped(self, reader: LogReader, pair: Synchronise) -> dict[str, int]:
        """Everything that was lost on the way, by reason; zeros too."""
        drops = {name: reader.counts[name] for name in READER_DROPS}
        drops |= {name: count for name, count in pair.counts.items() if name.startswith("unpaired")}
        drops["broken"] += pair.counts["broken"]
        drops["queue"] = sum(stage.dropped for stage in self._graph.telemetry.stages if stage.name not in TICKERS)
        return drops

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        """The first signal ends the run whole; a second one ends it at once."""
        again, self._signal = self._signal, number
        self._graph.stop()
        if again and self._options.inline:  # nothing else reaches a stage that this thread is stuck in
            raise KeyboardInterrupt
