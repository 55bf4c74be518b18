"""The counters, timings and warnings of a run over a log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.logs.log_reader import LogReader
from omnid.core.control.motion_monitor import ADVICE
from omnid.core.places.place_map import PlaceMap
from omnid.diagnostics.input_warnings import input_warnings
from omnid.diagnostics.motion_status import motion_status
from omnid.diagnostics.run_statistics import RunCounters, RunStatistics
from omnid.diagnostics.status import stage_status, summary_status
from omnid.engine.telemetry import SummaryRow
from omnid.runs.pipeline import WiredStages
from omnid.runs.session import Session
from omnid.sinks.pose_collector import MapPoseCollector
from omnid.stages.synchronise import Synchronise
from omnid.transport.records import DiagnosticStatus

READER_DROPS: Final = ("late", "duplicate", "broken", "broken_records")
PAIRING_DROPS: Final = ("unpaired", "repeated")  # begin the names of its counts
BOOKKEEPING: Final = frozenset(  # left out of the timings
    {"progress", "statistics", "collect-poses", "collect-map", "collect-places"}
)


class RunReport:
    """Counters, timings, warnings and final status of a run over a log, read from its parts."""

    def __init__(self, session: Session, reader: LogReader, pairing: Synchronise, stages: WiredStages) -> None:
        self._session, self._reader, self._pairing, self._stages = session, reader, pairing, stages

    def counters(self, statistics: RunStatistics) -> RunCounters:
        """Return the counters of the run with the given statistics."""
        counters = RunCounters.of(statistics, self._pairing.counts["pairs"], self._drops())
        mapping, places = self._stages.mapping, self._stages.places
        return replace(
            counters, map={} if mapping is None else mapping.counts, places={} if places is None else places.counts
        )

    def places(self) -> PlaceMap | None:
        """Return the map of places as it can be saved; None where there is none."""
        return None if self._stages.places is None else self._stages.places.map()

    def map_poses(self, poses: MapPoseCollector) -> NDArray[np.float64]:
        """Return the collected poses in the map (N, 4, 4) as it is at the end: later loops have corrected them."""
        places = self._stages.places
        found = [] if places is None else [places.corrected(update) for update in poses.updates]
        return np.array(found).reshape(-1, 4, 4)

    def known_in_map(self, poses: MapPoseCollector) -> NDArray[np.bool_]:
        """Return at which of the collected poses (N,) it is known at the end where odom lay in the map."""
        places = self._stages.places
        return np.zeros(0, np.bool_) if places is None else places.known(poses.updates)

    def timings(self) -> dict[str, SummaryRow]:
        """Return the times of the stages."""
        rows = self._session.graph.telemetry.summary()
        return {row.stage: row for row in rows if row.stage not in BOOKKEEPING}

    def warnings(self) -> Iterator[str]:
        """Return warnings about the log and the images."""
        yield from self._reader.warnings
        statistics = self._session.statistics
        if statistics.poses or not self._session.signal:
            fault = self._stages.front_end.odometry.last_fault
            if fault.reason:
                yield f"{fault.reason} {fault.detail}; {ADVICE}"
            message = self._motion().message if self._has_motion else ""
            if message and not (fault.reason and message.startswith(fault.reason)):
                yield f"wheels and gyro: {message}"
            if self._stages.floor is not None and self._stages.floor.summary():
                yield self._stages.floor.summary()
            health = self._stages.front_end.health
            yield from input_warnings(self._pairing, health, statistics, self._session.config)

    def final_status(self, statistics: RunStatistics) -> list[DiagnosticStatus]:
        """Return the counters of the run and of its stages, for the log."""
        stages = (stats for stats in self._session.graph.telemetry.stages if stats.name not in BOOKKEEPING)
        motion = [self._motion()] if self._has_motion else []
        return [summary_status(self.counters(statistics)), *motion, *map(stage_status, stages)]

    @property
    def _has_motion(self) -> bool:
        inbox = self._pairing.motion
        return bool(inbox.wheels or inbox.gyro)

    def _motion(self) -> DiagnosticStatus:
        return motion_status(self._stages.front_end.odometry, self._pairing.motion)()

    def _drops(self) -> dict[str, int]:
        """Return all that was lost, by reason; zeros too."""
        drops = {name: self._reader.counts[name] for name in READER_DROPS}
        drops |= {name: count for name, count in self._pairing.counts.items() if name.startswith(PAIRING_DROPS)}
        drops["broken"] += self._pairing.counts["broken"]
        drops["queue"] = self._session.dropped_messages()
        return drops
