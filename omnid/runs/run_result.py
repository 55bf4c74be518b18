"""The result of a run over a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omnid.core.mapping.voxel_map import MapPoints
from omnid.core.places.place_map import PlaceMap
from omnid.diagnostics.run_statistics import RunCounters
from omnid.engine.telemetry import SummaryRow
from omnid.errors import OmnidError
from omnid.formats.ply import write_ply
from omnid.formats.tum import tum_row
from omnid.runs.place_maps import RigPlaces
from omnid.tracking_state import MapState, TrackingState


@dataclass(frozen=True, slots=True, eq=False)
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
    # Poses in the map as it is at the end, and as they were known at that time (live), with their states then; empty
    # where places are not recognised.
    T_map_rig: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (N, 4, 4)
    T_map_rig_live: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (N, 4, 4)
    map_states: tuple[MapState, ...] = ()  # (N,)
    places: PlaceMap | None = None  # keyframes by which the places are recognised; None as above
    rig_places: RigPlaces | None = None  # the map of places that the run was given, extended

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
