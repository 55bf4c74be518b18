"""A run over a recorded log: opens inputs and outputs, runs the stages, returns the result."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib.rig import Rig
from calib.rig_file import png, read_rig, rig_toml
from drivers.frame import Frame
from drivers.logs.log_reader import WHOLE, LogCameras, LogReader, MotionTopics
from drivers.motion import MotionSample
from omnid.config import Config
from omnid.core.control.motion_monitor import ADVICE
from omnid.core.mapping.voxel_map import MapPoints
from omnid.core.places.place_map import PlaceMap
from omnid.diagnostics.status import RunCounters, RunStatistics, input_warnings, pair_loss
from omnid.engine.graph import POLL_S, Graph, Step, sleep_until
from omnid.engine.robot_clock import log_time
from omnid.errors import OmnidError
from omnid.formats.exports import write_ply, write_whole
from omnid.formats.plan import drawn_heights, plan_view
from omnid.formats.tum import Trajectory, read_tum
from omnid.messages import MapUpdate, PlaceUpdate
from omnid.recordings.evaluation import Metrics, evaluate
from omnid.runs.files import RunPlaces
from omnid.runs.wiring import BACKGROUND, Inputs, Session, attached_rig, run_to_end, wire
from omnid.settings import dump
from omnid.sinks.encoder import BusSink, Encoder, Outgoing
from omnid.sinks.files import TrajectoryFile, check_outputs, write_trajectory
from omnid.sinks.recorder import Recorder, SingleLog
from omnid.stages.front_end import FrontEnd
from omnid.stages.mapping import Places
from omnid.stages.obstacles import FLOOR_WARNING
from omnid.tracking_state import MapState, TrackingState
from omnid.transport.status_names import MOTION, RUN_ID, entry

Topics: TypeAlias = tuple[str | None, str | None]  # of the lower and the upper camera


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """Inputs and outputs of a run over a log."""

    rig: Path | Rig | None = None  # None: the rig.toml that is attached to the log
    topics: Topics = (None, None)  # of the images; None: those of the rig, else by their names
    span_s: tuple[float, float] = WHOLE  # the part of the log, from and until in seconds after its first image
    tum: Path | None = None
    map_tum: Path | None = None
    cloud: Path | None = None
    plan: Path | None = None
    record: Path | None = None
    collect: bool = False  # keep poses and map in memory for the result: 0.7 kB a pose
    publish: bool = False
    inline: bool = False
    paced: bool = False  # at the pace of the log's stamps, unless the computer is slower; False: as fast as possible
    settings: Path | None = None  # file of the configuration, so that no output overwrites it
    # Called ten times a second and at the end, with statistics, expected pairs, and whether the run has ended.
    progress: Callable[[RunStatistics, int | None, bool], object] | None = None
    observer: Callable[[FrontEnd], Step[Outgoing, None]] | None = None  # of all messages; excludes record
    map_every_s: float = 0.0  # between two maps, by the stamps; 0: one, at the end

    @property
    def files(self) -> list[tuple[str, Path]]:
        """The files that are written, each with its option."""
        names = ("tum", "map_tum", "cloud", "plan", "record")
        return [(f"--{name.replace('_', '-')}", path) for name in names if (path := getattr(self, name)) is not None]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RunResult:
    """Poses, map, counters, timings and warnings of a run.

    Poses are T_odom_rig: they map points of the rig frame into odom, which is the rig frame of the first pair
    (p_odom = T_odom_rig @ p_rig; x forward, y left, z up; m). There is one pose for every pair of images, its stamp is
    that of the lower camera's image. Without collection (ReplayOptions.collect) the arrays are empty and the map is
    None; counters, timings and warnings are always there.
    """

    stamps_ns: NDArray[np.int64]  # (N,) as in the log: ns of Unix time
    T_odom_rig: NDArray[np.float64]  # (N, 4, 4)
    covariances: NDArray[np.float64]  # (N, 6, 6) of the poses, [t; r] in the axes of the rig, m^2 and rad^2
    states: tuple[TrackingState, ...]  # (N,)
    counters: RunCounters
    timings: Mapping[str, Mapping[str, float]]  # by stage: n (messages), drops, p50_ms, p99_ms and max_ms of one
    warnings: tuple[str, ...]  # problems of the input, with remedies, one line each
    map: MapPoints | None  # points (M, 3) m in odom, with confidence, frames and age; None without a pair
    signal: int = 0  # number of the signal that ended the run early; 0: it came to its end
    # Poses in the map: by the map at the end, and as known while driving (live) with the states then. Empty if places
    # are not recognised.
    T_map_rig: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (N, 4, 4)
    T_map_rig_live: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (N, 4, 4)
    map_states: tuple[MapState, ...] = ()  # (N,)
    places: PlaceMap | None = None  # keyframes by which the places are recognised; None as above
    map_file: Path | None = None  # of places, where the run has written one
    elapsed_s: float = 0.0  # time that the stages took, without the start

    def __repr__(self) -> str:
        """Return one line: poses, length and warnings."""
        found = self.counters
        return f"<RunResult: {found.poses} poses, {found.length_m:.2f} m, {len(self.warnings)} warnings>"

    def evaluate(
        self, truth: str | PathLike[str] | Trajectory, *, tolerance_s: float = 0.01, alignment: str = "origin"
    ) -> Metrics:
        """Return the errors of the poses against a true trajectory, as `omnid eval` prints them.

        truth: a TUM file, or a Trajectory of T_world_rig. tolerance_s: largest difference of the stamps of two poses.
        alignment: "origin" (the first poses coincide), or "rigid" (all positions do, least squares).

        Raises OmnidError for a file that cannot be read and for fewer than two poses at the same times.
        """
        true = truth if isinstance(truth, Trajectory) else read_tum(Path(truth))
        return evaluate(Trajectory(self.stamps_ns, self.T_odom_rig), true, tolerance_s, alignment)

    def save_tum(self, path: str | PathLike[str]) -> None:
        """Write the trajectory: a row `t x y z qx qy qz qw` for each pose (s, m, unit quaternion).

        Raises OmnidError where the poses were not collected or the file cannot be written.
        """
        if len(self.stamps_ns) < self.counters.poses:
            raise OmnidError(f"{path}: the poses of this run were not collected: run it with collect=True")
        write_trajectory(Path(path), self.stamps_ns, self.T_odom_rig)

    def save_ply(self, path: str | PathLike[str]) -> None:
        """Write the map as a binary PLY file: x y z [m], confidence, frames and age of every point.

        Raises OmnidError where there is no map or the file cannot be written.
        """
        if self.map is None:
            raise OmnidError(f"{path}: this run has no map: it found no pair of images, or it did not collect")
        write_ply(Path(path), self.map)


def run_log(log: Path, config: Config, options: ReplayOptions | None = None) -> RunResult:
    """Run a log (any that open_log reads) through the stages and return the result.

    Prints nothing. A first SIGINT, SIGTERM or SIGHUP ends the run early with whole files and `signal` in the result; a
    second one ends the process at once. Raises OmnidError, DriverError or CalibError for wrong input and
    outputs that cannot be written.
    """
    options = options or ReplayOptions()
    # 1. No output may be an input, or another output.
    named = [("log", log), ("rig", options.rig), ("configuration", options.settings)]
    check_outputs(options.files, [(f"the {what} that is read", path) for what, path in named if isinstance(path, Path)])
    if options.map_tum and not config.places.enabled:
        raise OmnidError("--map-tum: places.enabled = false, so that there is no pose in the map; leave one out")
    graph = Graph(threaded=not options.inline)
    with ExitStack() as closing:
        # 2. The log and its rig; compiling may take a minute, so that a log or a rig that is wrong is refused first.
        warnings = list[str]()
        session = Session(config, graph, closing, warnings.append, RunStatistics())
        given_rig = read_rig(options.rig) if isinstance(options.rig, Path) else options.rig
        cameras = LogCameras(*options.topics, config.cameras.bits, config.log.time)
        topics = given_rig.topics if given_rig else ("", "")
        named_motion = {"auto": None, "off": ""}  # None: the only topic of the log, "": none
        motion = MotionTopics(*(named_motion.get(name, name) for name in (config.motion.wheels, config.motion.imu)))
        reader = LogReader(log, cameras, topics, span_s=options.span_s, motion=motion)
        closing.callback(reader.close)
        geometry = session.geometry(given_rig or attached_rig(reader, log), reader.frames())
        front_end = FrontEnd(geometry, config)
        run_places = RunPlaces(config, geometry, session.warn)

        # 3. The stages.
        paced = partial(_paced, reader, graph)
        messages = graph.source("read", paced if options.paced else reader.messages)
        inputs = Inputs([messages], run_places, map_every_s=options.map_every_s)
        streams = wire(config, inputs, front_end, graph)
        poses, maps = streams.poses, streams.maps

        # 4. The outputs; one that cannot be opened ends the run before it begins. A pose that is kept, with its
        #    covariance, takes 0.7 kB: 75 MB an hour at 30 Hz.
        collected, kept = list[tuple[Any, ...]](), attrgetter("stamp_ns", "T_odom_rig", "covariance", "state")
        updates, newest_map = list[PlaceUpdate](), deque[MapUpdate](maxlen=1)
        rig = geometry.rig
        encoder = partial(Encoder, rig, config.obstacles.scan.max_range_m)
        graph.sink("statistics", session.statistics, poses, thread=poses.thread)
        if options.collect:
            graph.sink("collect-poses", lambda pose: collected.append(kept(pose)), poses, thread=BACKGROUND)
            graph.sink("collect-map", newest_map.append, maps, thread=BACKGROUND)
        if options.tum:
            graph.sink("trajectory", TrajectoryFile(options.tum), poses, thread=BACKGROUND)
        if streams.in_map is not None and (options.map_tum or options.collect):
            graph.sink("collect-places", updates.append, streams.in_map, thread=BACKGROUND)
        if cloud := options.cloud:  # each map replaces the file
            graph.sink("map", lambda update: write_ply(cloud, update.points), maps, thread=BACKGROUND)
        if plan := options.plan:
            heights_m = drawn_heights(rig.height_m(config.obstacles.scan.floor_m) or 0.0)
            graph.sink(
                "plan",
                lambda now: write_whole(plan, png(plan_view(now.points, now.path_xy, heights_m=heights_m))),
                maps,
                thread=BACKGROUND,
            )
        if options.publish:
            bus = session.open_bus(rig, gives_time=True)
            streams.publish(graph, BusSink(bus, encoder(run_id=RUN_ID), gives_time=True))
        observer = options.observer(front_end) if options.observer else None
        if options.record:
            attachments = {"rig.toml": rig_toml(rig).encode(), "omnid.toml": dump(config).encode()}
            observer = Recorder(SingleLog(options.record, attachments), config.bus.robot, log_time(), encoder())
            closing.callback(observer.close)
        if observer is not None:
            graph.sink("record", observer, *(one.stream for one in streams.leaving))
        if options.progress is not None:
            show = partial(options.progress, session.statistics, reader.pair_estimate())
            closing.callback(show, True)
            session.every(POLL_S, partial(show, False), "progress")

        # 5. The run, and its counters.
        begun_s = time.monotonic()
        with graph.signals():
            run_to_end(graph, run_places)
        places = streams.places if "places" in graph.stats else None  # they have a reader
        found, read, paired = session.statistics, reader.counts, front_end.pairing.stats()
        # Losses by reason, zeros too.
        drops = {name: read[name] for name in ("duplicate", "broken", "broken_records")}
        drops |= {name: count for name, count in paired.items() if name.startswith(("unpaired", "repeated"))}
        drops["broken"] += paired["broken"]
        counters = RunCounters(
            paired["pairs"],
            found.poses,
            found.length_m,
            {state: found.states[state] for state in TrackingState},
            found.newest.reset_counter if found.newest else 0,
            drops,
            {} if places is None else places.counts,
            pair_loss(front_end.pairing, read),
        )
        kept_stamps_ns, kept_poses, kept_covariances, kept_states = tuple(zip(*collected, strict=True)) or 4 * ((),)

        # 6. Poses in the map: corrected by its later loops, and as they were known while driving.
        corrected = [] if places is None else [places.corrected(each) for each in updates]
        in_map = np.array(corrected, float).reshape(-1, 4, 4)
        live = np.array([each.T_map_rig for each in updates], float).reshape(-1, 4, 4)
        if options.map_tum and places is not None and updates:
            stamps_ns, known = np.array([each.stamp_ns for each in updates], np.int64), places.known(updates)
            if not known.all():
                warnings.append(
                    f"{options.map_tum}: {len(known) - known.sum()} of {len(known)} poses are left out: no place of "
                    "the map was recognised there, so it is not known where in it they are"
                )
            write_trajectory(options.map_tum, stamps_ns[known], in_map[known])
        return RunResult(
            np.array(kept_stamps_ns, np.int64),
            np.array(kept_poses, np.float64).reshape(-1, 4, 4),
            np.array(kept_covariances, np.float64).reshape(-1, 6, 6),
            tuple(kept_states),
            counters,
            {
                name: {"n": one.processed, "drops": one.dropped, **one.wall.times_ms()}
                for name, one in graph.stats.items()
            },
            (*dict.fromkeys(warnings), *_run_warnings(session, reader, front_end, places, counters)),
            newest_map[0].points if newest_map else None,
            graph.signal,
            in_map,
            live,
            tuple(each.state for each in updates),
            places.map() if places is not None and options.collect else None,
            run_places.written,
            time.monotonic() - begun_s,
        )


def _paced(reader: LogReader, graph: Graph) -> Iterator[Frame | MotionSample]:
    """Yield the messages of a log when their stamps are due."""
    offset_ns: int | None = None
    for message in reader.messages():
        if offset_ns is None:
            offset_ns = time.monotonic_ns() - message.stamp_ns
        sleep_until(message.stamp_ns + offset_ns, lambda: graph.is_stopping)
        yield message


def _run_warnings(
    session: Session, reader: LogReader, front_end: FrontEnd, places: Places | None, counters: RunCounters
) -> Iterator[str]:
    """Yield warnings about the log and the images."""
    yield from reader.warnings
    if counters.loss:
        yield counters.loss
    if not counters.poses and session.graph.signal:
        return
    fault, motion = front_end.last_fault, front_end.pairing.motion
    if fault.reason:
        yield f"{fault.reason} {fault.detail}; {ADVICE}"
    message = entry(MOTION, front_end.motion_stats()).message if motion.wheels or motion.gyro else ""
    if message and not (fault.reason and message.startswith(fault.reason)):
        yield f"wheels and gyro: {message}"
    config, rig = session.config, front_end.geometry.rig
    if places and rig.height_m(config.obstacles.scan.floor_m) is None:
        yield FLOOR_WARNING
    yield from front_end.image_faults
    yield from input_warnings(front_end.pairing, front_end.health, session.statistics, config)
