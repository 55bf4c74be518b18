"""The result of a run in memory, and the report of it that is printed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.logs.log_reader import LogReader
from omnid.core.control.motion_monitor import ADVICE
from omnid.core.mapping.voxel_map import MapPoints
from omnid.core.places.place_map import PlaceMap
from omnid.diagnostics.run_summary import RunCounters, input_warnings
from omnid.diagnostics.status import stage_stats, summary_stats
from omnid.engine.telemetry import SummaryRow
from omnid.errors import OmnidError
from omnid.formats.exports import write_ply
from omnid.formats.tum import Trajectory, read_tum, tum_row
from omnid.recordings.evaluation import Metrics, evaluate
from omnid.runs.place_maps import RigPlaces
from omnid.runs.session import Session
from omnid.runs.wiring import WiredStages
from omnid.tracking_state import MapState, TrackingState
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.status_names import MOTION, SUMMARY, entry, stage_name


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
    timings: Mapping[str, SummaryRow]  # by stage: messages, drops, p50, p99 and maximum of the time of one [ms]
    warnings: tuple[str, ...]  # doubts about the input and what to do about them, one line each
    map: MapPoints | None  # points (M, 3) m in odom, with confidence, frames and age; None without a pair
    signal: int = 0  # number of the signal that ended the run early; 0: it came to its end
    # Poses in the map: by the map at the end, and as known while driving (live) with the states then. Empty if places
    # are not recognised.
    T_map_rig: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (N, 4, 4)
    T_map_rig_live: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (N, 4, 4)
    map_states: tuple[MapState, ...] = ()  # (N,)
    places: PlaceMap | None = None  # keyframes by which the places are recognised; None as above
    rig_places: RigPlaces | None = None  # the map of places that the run was given, extended
    map_file: Path | None = None  # of places, where the run has written one
    elapsed_s: float = 0.0  # time that the stages took, without the start

    def __repr__(self) -> str:
        """Return one line: poses, span, length, states, map points and warnings."""
        span_s = 1e-9 * float(self.stamps_ns[-1] - self.stamps_ns[0]) if len(self.stamps_ns) else 0.0
        length_m = float(np.linalg.norm(np.diff(self.T_odom_rig[:, :3, 3], axis=0), axis=1).sum())
        states = ", ".join(f"{count} {state}" for state, count in Counter(self.states).most_common())
        points = "no map" if self.map is None else f"{len(self.map.xyz)} map points"
        return (
            f"<RunResult: {self.counters.poses} poses{f' ({states})' if states else ''}, {span_s:.1f} s, "
            f"{length_m:.2f} m, {points}, {len(self.warnings)} warnings>"
        )

    def evaluate(
        self, truth: str | PathLike[str] | Trajectory, *, tolerance_s: float = 0.01, alignment: str = "origin"
    ) -> Metrics:
        """Return the errors of the poses against a true trajectory, as `omnid eval` prints them.

        truth: a TUM file, or a Trajectory of T_world_rig. tolerance_s: largest difference of the stamps of two poses.
        alignment: "origin" (the first poses coincide), "rigid" or "scale" (all positions do, least squares).

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
        rows = [tum_row(int(stamp_ns), T) + "\n" for stamp_ns, T in zip(self.stamps_ns, self.T_odom_rig, strict=True)]
        try:
            Path(path).write_text("".join(rows), "ascii")
        except (OSError, ValueError) as error:  # ValueError: a NUL in the name
            raise OmnidError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error

    def save_ply(self, path: str | PathLike[str]) -> None:
        """Write the map as a binary PLY file: x y z [m], confidence, frames and age of every point.

        Raises OmnidError where there is no map or the file cannot be written.
        """
        if self.map is None:
            raise OmnidError(f"{path}: this run has no map: it found no pair of images, or it did not collect")
        write_ply(Path(path), self.map)


class RunFailedError(OmnidError):
    """An error that ended a run after its first pose; `result` holds what was found until then."""

    def __init__(self, message: str, result: RunResult) -> None:
        super().__init__(message)
        self.result = result


BOOKKEEPING: Final = frozenset(  # left out of the timings
    {"progress", "statistics", "collect-poses", "collect-map", "collect-places"}
)


class RunReport:
    """Counters, timings, warnings and final status of a run over a log, read from its parts."""

    def __init__(self, session: Session, reader: LogReader, stages: WiredStages) -> None:
        self._session, self._reader, self._stages = session, reader, stages
        self._pairing, self._odometry = stages.front_end.pairing, stages.front_end.odometry

    def counters(self) -> RunCounters:
        """Return the counters of the run; all that was lost, by reason, zeros too."""
        read, paired, telemetry = self._reader.counts, self._pairing.counts, self._session.graph.telemetry
        drops = {name: read[name] for name in ("duplicate", "broken", "broken_records")}
        drops |= {name: count for name, count in paired.items() if name.startswith(("unpaired", "repeated"))}
        drops["broken"] += paired["broken"]
        drops["queue"] = telemetry.dropped_messages
        mapping, places = self._stages.mapping, self._stages.places
        return replace(
            RunCounters.of(self._session.statistics, paired["pairs"], drops),
            map={} if mapping is None else mapping.counts,
            places={} if places is None else places.counts,
            loss=self._loss(),
        )

    def timings(self) -> dict[str, SummaryRow]:
        """Return the times of the stages."""
        rows = self._session.graph.telemetry.summary()
        return {row.stage: row for row in rows if row.stage not in BOOKKEEPING}

    def warnings(self) -> Iterator[str]:
        """Return warnings about the log and the images."""
        yield from self._reader.warnings
        if self._loss():
            yield self._loss()
        statistics = self._session.statistics
        if not statistics.poses and self._session.signal:
            return
        fault = self._odometry.last_fault
        if fault.reason:
            yield f"{fault.reason} {fault.detail}; {ADVICE}"
        message = "".join(status.message for status in self._motion())
        if message and not (fault.reason and message.startswith(fault.reason)):
            yield f"wheels and gyro: {message}"
        if self._stages.floor is not None and self._stages.floor.summary():
            yield self._stages.floor.summary()
        yield from self._odometry.image_faults
        yield from input_warnings(self._pairing, self._stages.front_end.health, statistics, self._session.config)

    def final_status(self) -> list[DiagnosticStatus]:
        """Return the counters of the run and of its stages, for the log."""
        stages = (stats for stats in self._session.graph.telemetry.stages if stats.name not in BOOKKEEPING)
        found = [entry(stage_name(stage.name), stage_stats(stage)) for stage in stages]
        return [entry(SUMMARY, summary_stats(self.counters())), *self._motion(), *found]

    def _loss(self) -> str:
        """Return one line about images that make no pair; empty where these are few, or were dropped on purpose."""
        dropped = self._session.graph.telemetry.dropped_messages
        return "" if dropped else self._pairing.loss(self._reader.counts)

    def _motion(self) -> list[DiagnosticStatus]:
        """Return the entry of wheels and gyro, if there were any."""
        inbox = self._pairing.motion
        return [entry(MOTION, self._stages.front_end.motion_stats())] if inbox.wheels or inbox.gyro else []
