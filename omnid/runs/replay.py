"""A run over a recorded log: opens inputs and outputs, runs the stages, returns the result."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib.rig import Rig
from calib.rig_file import read_rig, rig_toml
from drivers.errors import DriverError
from drivers.frame import Frame
from drivers.logs.log_reader import WHOLE, LogReader
from drivers.motion import MotionSample
from omnid.config import Config
from omnid.core.control.motion_monitor import ADVICE
from omnid.diagnostics.run_summary import RunCounters, RunStatistics, input_warnings, pair_loss
from omnid.diagnostics.status import stage_stats, summary_stats
from omnid.engine.graph import LOSSLESS, NEWEST, Graph, Sink
from omnid.engine.kernel_cache import prepare_kernels
from omnid.engine.realtime import RealtimeSettings
from omnid.engine.telemetry import Telemetry
from omnid.engine.threads import POLL_S, sleep_until
from omnid.errors import OmnidError
from omnid.formats.exports import write_ply
from omnid.formats.plan import drawn_heights
from omnid.messages import MapUpdate, OdometryUpdate, PlaceUpdate
from omnid.runs.place_maps import RunPlaces
from omnid.runs.run_result import RunResult
from omnid.runs.session import Session, attached_rig, motion_topics, run_to_end
from omnid.runs.wiring import Inputs, Outputs, wire
from omnid.settings import dump
from omnid.sinks.bus_sink import BusSink
from omnid.sinks.drive import ReplayDrive
from omnid.sinks.encoder import Outgoing, StatusReport
from omnid.sinks.files import TrajectoryFile, check_outputs, write_plan, write_trajectory
from omnid.sinks.recorder import Recorder, SingleLog
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry
from omnid.tracking_state import TrackingState
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.status_names import MOTION, SUMMARY, entry, stage_name

Array = NDArray[np.float64]
Topics: TypeAlias = tuple[str | None, str | None]  # of the lower and the upper camera
UNPRIVILEGED: Final = RealtimeSettings(lock_memory=False, motor_priority=0)  # of the controller process of a replay


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """Inputs and outputs of a run over a log."""

    rig: Path | Rig | None = None  # None: the rig.toml that is attached to the log
    topics: Topics = (None, None)  # of the images; None: those of the rig, else by their names
    span_s: tuple[float, float] = WHOLE  # the part of the log, from and until in seconds after its first image
    tum: Path | None = None
    map_tum: Path | None = None
    map_live_tum: Path | None = None  # poses in the map as they were known when they were computed
    cloud: Path | None = None
    plan: Path | None = None
    record: Path | None = None
    collect: bool = False  # keep poses and map in memory for the result: 0.7 kB a pose
    publish: bool = False
    inline: bool = False
    paced: bool = False  # at the pace of the log's stamps, unless the computer is slower; False: as fast as possible
    drops: bool = False  # a late stage drops messages, as on the robot; False: the stages before it wait
    settings: Path | None = None  # file of the configuration, so that no output overwrites it
    # Called ten times a second and at the end, with statistics, expected pairs, and whether the run has ended.
    progress: Callable[[RunStatistics, int | None, bool], object] | None = None
    observer: Callable[[FrontEnd, Telemetry], Sink[Outgoing]] | None = None  # of all messages; excludes record
    map_every_s: float = 0.0  # between two maps, by the stamps; 0: one, at the end

    @property
    def files(self) -> list[tuple[str, Path]]:
        """The files that are written, each with its option."""
        names = ("tum", "map_tum", "map_live_tum", "cloud", "plan", "record")
        return [(f"--{name.replace('_', '-')}", path) for name in names if (path := getattr(self, name)) is not None]


def run_log(log: Path, config: Config, options: ReplayOptions | None = None) -> RunResult:
    """Run a log (an MCAP file or a folder of them) through the stages and return the result.

    Prints nothing. A first SIGINT, SIGTERM or SIGHUP ends the run early with whole files and `signal` in the result;
    a second one raises KeyboardInterrupt. Raises OmnidError, DriverError or CalibError for wrong input and outputs that
    cannot be written.
    """
    return _Replay(log, config, options or ReplayOptions()).run()


class _Replay:
    def __init__(self, log: Path, config: Config, options: ReplayOptions) -> None:
        self._log, self._config, self._options = log, config, options
        # Stamp [ns], T_odom_rig, covariance and state of each pose: 0.7 kB, 75 MB an hour at 30 Hz.
        self._poses: list[tuple[int, Array, Array, TrackingState]] = []
        self._in_map: list[PlaceUpdate] = []
        self._map: deque[MapUpdate] = deque(maxlen=1)  # the newest one
        self._wheels: ReplayDrive | None = None
        self._warnings: list[str] = []
        self._begun_s = 0.0

    def run(self) -> RunResult:
        options, config = self._options, self._config
        check_outputs(options.files, self._inputs())
        in_map = [name for name, _ in options.files if name in ("--map-tum", "--map-live-tum")]
        if in_map and not config.places.enabled:
            raise OmnidError(f"{in_map[0]}: places.enabled = false, so that there is no pose in the map; leave one out")
        graph = Graph(policy=NEWEST if options.drops else LOSSLESS, threaded=not options.inline)
        with ExitStack() as outputs:
            self._session = session = Session(config, graph, outputs, self._warnings.append)
            # 1. The log and its rig.
            self._reader = reader = self._opened()
            outputs.callback(reader.close)
            geometry = session.geometry(self._rig(), reader.frames())
            prepare_kernels()  # may take a minute: after a log or a rig that is wrong was refused
            self._front_end = front_end = FrontEnd(geometry, config)
            # 2. The stages, between the log and the outputs; one that cannot be opened ends the run before it begins.
            run_places = RunPlaces(config, geometry, session.warn)
            messages, sinks = graph.source("read", self._messages()), self._outputs(geometry)
            inputs = Inputs([messages], run_places, map_every_s=options.map_every_s)
            self._stages = wire(config, inputs, front_end, graph, sinks)
            if options.progress is not None:
                show = partial(options.progress, session.statistics, reader.pair_estimate())
                graph.ticker("progress", POLL_S, partial(show, False))
                outputs.callback(show, True)
            # 3. The run.
            self._begun_s = time.monotonic()
            with session.signals(self._on_signal):
                run_to_end(graph, run_places)  # before the result is made: it may warn
            self._end_recording(sinks.recorder)
            return replace(self._result(), map_file=run_places.written)

    def _inputs(self) -> list[tuple[str, Path]]:
        """The files that are read, each with its name for errors."""
        logs = [self._log, *sorted(self._log.glob("*.mcap"))]  # those of a folder also by another name
        named = [*(("log", log) for log in logs), ("rig", self._options.rig), ("configuration", self._options.settings)]
        return [(f"the {what} that is read", path) for what, path in named if isinstance(path, Path)]

    def _opened(self) -> LogReader:
        """Open the log; the topics are those of the options, else of the rig, else found by their names."""
        lower, upper = self._options.topics
        rig, log = self._options.rig, self._config.log
        open_log = partial(
            LogReader,
            self._log,
            span_s=self._options.span_s,
            motion=motion_topics(self._config),
            bits=self._config.cameras.bits,
            rate_hz=log.rate_hz,
            time=log.time,
        )
        if rig and not (lower and upper):
            named = (read_rig(rig) if isinstance(rig, Path) else rig).topics
            if all(named):
                with suppress(DriverError):  # the topics may have been renamed since the rig was calibrated
                    return open_log(lower or named[0], upper or named[1])
        return open_log(lower, upper)

    def _rig(self) -> Rig:
        found = self._options.rig
        if found is None:
            return attached_rig(self._reader, self._log)
        return read_rig(found) if isinstance(found, Path) else found

    def _messages(self) -> Callable[[], Iterator[Frame | MotionSample]]:
        """Return the source of the log; paced, each message comes when its stamp is due."""
        messages, graph = self._reader.messages, self._session.graph
        motion = self._front_end.pairing.motion

        def paced() -> Iterator[Frame | MotionSample]:
            offset_ns: int | None = None
            for message in messages():
                if offset_ns is None:
                    offset_ns = time.monotonic_ns() - message.stamp_ns
                sleep_until(message.stamp_ns + offset_ns, lambda: graph.is_stopping)
                if isinstance(message, Frame):
                    yield message
                else:  # in the inbox of the pairing samples would replace frames
                    motion.add(message)

        return paced if self._options.paced else messages

    def _outputs(self, geometry: Geometry) -> Outputs:
        """Open all outputs."""
        options, config, session = self._options, self._config, self._session
        outputs = Outputs(counters={"statistics": session.statistics})
        if options.collect:
            outputs.poses["collect-poses"] = lambda pose: self._poses.append(
                (pose.stamp_ns, pose.T_odom_rig, pose.covariance, TrackingState(pose.state))
            )
            outputs.maps["collect-map"] = self._map.append
        if options.tum:
            outputs.poses["trajectory"] = TrajectoryFile(options.tum)
        if options.map_tum or options.map_live_tum or options.collect:
            outputs.places["collect-places"] = self._in_map.append
        if cloud := options.cloud:  # each map replaces the file
            outputs.maps["map"] = lambda update: write_ply(cloud, update.points)
        if plan := options.plan:
            heights_m = drawn_heights(geometry.rig.height_m(config.obstacles.scan.floor_m) or 0.0)
            outputs.maps["plan"] = lambda update: write_plan(plan, update.points, update.path_xy, heights_m)
        recorder: Sink[Any] | None = None
        if options.observer:
            recorder = options.observer(self._front_end, session.graph.telemetry)
        if options.record:
            attachments = {"rig.toml": rig_toml(geometry.rig).encode(), "omnid.toml": dump(config).encode()}
            log = SingleLog(options.record, attachments)
            recorder = Recorder(log, config.bus.robot, session.encoder(geometry.rig))
            session.outputs.callback(recorder.close)
        if config.motor.port:
            controller = session.start_controller(UNPRIVILEGED, of_replay=True)
            setpoint = config.controller.setpoint.setpoint()
            health, T_base_rig = self._front_end.health, geometry.rig.T_base_rig
            outputs.counters["controller"] = self._wheels = ReplayDrive(controller, setpoint, T_base_rig, health)
        bus: BusSink | None = None
        if options.publish:
            encode = session.encoder(geometry.rig)
            bus = BusSink(session.open_bus(geometry.rig, gives_time=True), encode, clock=OdometryUpdate)
        return replace(outputs, bus=bus, recorder=recorder)

    def _on_signal(self, again: bool) -> None:
        if again and self._options.inline:  # nothing else interrupts the stage that runs in this thread
            raise KeyboardInterrupt

    def _counters(self) -> RunCounters:
        """Return the counters of the run; all that was lost, by reason, zeros too."""
        found, read, paired = self._session.statistics, self._reader.counts, self._front_end.pairing.counts
        drops = {name: read[name] for name in ("duplicate", "broken", "broken_records")}
        drops |= {name: count for name, count in paired.items() if name.startswith(("unpaired", "repeated"))}
        drops["broken"] += paired["broken"]
        drops["queue"] = self._session.graph.telemetry.dropped_messages
        mapping, places = self._stages.mapping, self._stages.places
        return RunCounters(
            paired["pairs"],
            found.poses,
            found.length_m,
            {state: found.states[state] for state in TrackingState},
            found.resets,
            drops,
            {} if mapping is None else mapping.counts,
            {} if places is None else places.counts,
            {} if self._wheels is None else self._wheels.counts(),
            "" if drops["queue"] else pair_loss(self._front_end.pairing, read),  # else they were dropped on purpose
        )

    def _about_input(self, counters: RunCounters) -> Iterator[str]:
        """Yield warnings about the log and the images."""
        odometry, floor = self._front_end.odometry, self._stages.floor
        yield from self._reader.warnings
        if counters.loss:
            yield counters.loss
        if not counters.poses and self._session.signal:
            return
        fault = odometry.last_fault
        if fault.reason:
            yield f"{fault.reason} {fault.detail}; {ADVICE}"
        message = "".join(status.message for status in self._motion())
        if message and not (fault.reason and message.startswith(fault.reason)):
            yield f"wheels and gyro: {message}"
        if floor is not None and floor.summary():
            yield floor.summary()
        yield from odometry.image_faults
        yield from input_warnings(
            self._front_end.pairing, self._front_end.health, self._session.statistics, self._config
        )

    def _motion(self) -> list[DiagnosticStatus]:
        """Return the entry of wheels and gyro, if there were any."""
        inbox = self._front_end.pairing.motion
        return [entry(MOTION, self._front_end.motion_stats())] if inbox.wheels or inbox.gyro else []

    def _end_recording(self, recorder: object) -> None:
        """Complete a recording with the counters of the run and of its stages, if it has messages."""
        if isinstance(recorder, Recorder) and recorder.state.messages:
            stages = self._session.graph.telemetry.stages
            found = [entry(stage_name(stage.name), stage_stats(stage)) for stage in stages]
            summary = replace(self._counters(), motor={})
            statuses = [entry(SUMMARY, summary_stats(summary)), *self._motion(), *found]
            recorder.process(StatusReport(recorder.newest_ns, statuses))
            recorder.close()

    def _result(self) -> RunResult:
        options, places, updates, session = self._options, self._stages.places, self._in_map, self._session
        # 1. Poses in the map: as it is at the end, whose later loops have corrected them; and as they were known.
        found = [] if places is None else [places.corrected(each) for each in updates]
        known = np.zeros(0, bool) if places is None else places.known(updates)
        in_map, live = (np.array(T, float).reshape(-1, 4, 4) for T in (found, [each.T_map_rig for each in updates]))
        stamps_ns = np.array([each.stamp_ns for each in updates], np.int64)
        if path := options.map_tum:
            self._warnings += write_trajectory(path, stamps_ns, in_map, known)
        if path := options.map_live_tum:
            known_live = np.array([each.is_known for each in updates], bool)
            self._warnings += write_trajectory(path, stamps_ns, live, known_live)
        # 2. All that was found.
        counters = self._counters()
        collected = zip(*self._poses, strict=True) if self._poses else ((), (), (), ())
        pose_stamps_ns, poses, covariances, states = collected
        return RunResult(
            np.array(pose_stamps_ns, np.int64),
            np.array(poses, np.float64).reshape(-1, 4, 4),
            np.array(covariances, np.float64).reshape(-1, 6, 6),
            tuple(states),
            counters,
            {row.stage: row for row in session.graph.telemetry.summary()},
            (*dict.fromkeys(self._warnings), *self._about_input(counters)),
            self._map[0].points if self._map else None,
            session.signal,
            in_map,
            live,
            tuple(each.state for each in updates),
            places.map() if places is not None and options.collect else None,
            elapsed_s=time.monotonic() - self._begun_s,
        )
