"""The result of a run in memory, and the report of it that is printed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.voxel_map import MapPoints
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.places.place_map import PlaceMap
from omnid.diagnostics.run_summary import RunCounters
from omnid.engine.telemetry import SummaryRow
from omnid.errors import OmnidError
from omnid.formats.exports import write_ply
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import Metrics, evaluate
from omnid.sinks.files import write_trajectory
from omnid.tracking_state import MapState, TrackingState


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
    map_file: Path | None = None  # of places, where the run has written one
    elapsed_s: float = 0.0  # time that the stages took, without the start

    def __repr__(self) -> str:
        """Return one line: poses, span, length, states, map points and warnings."""
        span_s = S_PER_NS * float(self.stamps_ns[-1] - self.stamps_ns[0]) if len(self.stamps_ns) else 0.0
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
        write_trajectory(Path(path), self.stamps_ns, self.T_odom_rig)

    def save_ply(self, path: str | PathLike[str]) -> None:
        """Write the map as a binary PLY file: x y z [m], confidence, frames and age of every point.

        Raises OmnidError where there is no map or the file cannot be written.
        """
        if self.map is None:
            raise OmnidError(f"{path}: this run has no map: it found no pair of images, or it did not collect")
        write_ply(Path(path), self.map)
