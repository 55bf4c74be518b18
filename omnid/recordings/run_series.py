"""A recorded run as arrays: poses, states and commands over time, for comparisons.

A pose takes 64 bytes and images are not read, so a recording of a working day can be held.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from calib import se3
from drivers.logs.mcap_info import LogInfo, LogState, read_log_info
from omnid.errors import OmnidError
from omnid.recordings.odometry_topic import choose_odometry_topic, no_pose
from omnid.recordings.recording_reader import DRIVE, ODOMETRY, STATUS, RecordingReader
from omnid.recordings.series_differences import Series
from omnid.tracking_state import TrackingState
from omnid.transport import status_names
from omnid.transport.decode import Diagnostics
from omnid.transport.records import OdometryRecord, TwistRecord
from omnid.transport.status_names import Key

STATES: Final = tuple(TrackingState)
MAX_ROWS: Final = 1 << 20  # Most rows of a series: 9 hours of poses at 30 Hz.


@dataclass(frozen=True, slots=True, eq=False)
class RunSeries:
    """Poses, states and commands of a recorded run."""

    path: Path
    topic: str  # topic of the poses
    poses: Series  # x y z [m], qx qy qz qw: T_odom_base
    states: Series  # index in STATES and reset counter, a row for each reported change
    drive: Series  # commands to the wheels, m/s and rad/s
    attachments: Mapping[str, bytes]
    warnings: tuple[str, ...]


def read_run_series(path: Path, topic: str | None = None) -> RunSeries:
    """Read a recorded run; topic: that of the poses, see choose_odometry_topic.

    Raise DriverError where there is no log, OmnidError where it has no poses or more than MAX_ROWS rows.
    """
    found = read_log_info(path)
    reader = RecordingReader(found, choose_odometry_topic(found, topic))
    columns = {ODOMETRY: _Column(7), STATUS: _Column(2), DRIVE: _Column(2)}
    for message in reader.messages(columns):
        match message.content:
            case OdometryRecord(stamp_ns, T):
                columns[ODOMETRY].add(stamp_ns, (*T[:3, 3].tolist(), *se3.quaternion(T[:3, :3]).tolist()))
            case Diagnostics():
                _add_state(columns[STATUS], message.content)
            case TwistRecord(stamp_ns, _, velocity_mps, yaw_rate_radps):
                columns[DRIVE].add(stamp_ns, (velocity_mps, yaw_rate_radps))
    poses, states, drive = (columns[name].series() for name in (ODOMETRY, STATUS, DRIVE))
    if not poses.stamps_ns.size:
        raise no_pose(path, reader.topic)
    warnings = _warnings(found, reader, {name: column.repeated for name, column in columns.items()})
    return RunSeries(found.path, reader.topic, poses, states, drive, reader.attachments, tuple(warnings))


class _Column:
    """Rows of a series in the order of arrival; of several with one stamp the first is kept."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._stamps, self._values = array("q"), array("d")
        self.repeated = 0  # rows left out by series()

    def add(self, stamp_ns: int, values: tuple[float, ...]) -> None:
        """Add a row. Raise OmnidError beyond MAX_ROWS."""
        if len(self._stamps) >= MAX_ROWS:
            raise OmnidError(
                f"a recording with more than {MAX_ROWS} poses, states or commands: cut it into shorter ones"
            )
        self._stamps.append(stamp_ns)
        self._values.extend(values)

    def series(self) -> Series:
        """Return the rows in the order of their stamps."""
        stamps_ns = np.frombuffer(self._stamps, np.int64) if self._stamps else np.empty(0, np.int64)
        values = np.frombuffer(self._values) if self._values else np.empty(0)
        kept, rows = np.unique(stamps_ns, return_index=True)  # the first of equals
        self.repeated = stamps_ns.size - kept.size
        return Series(kept, values.reshape(-1, self._width)[rows])


def _add_state(column: _Column, diagnostics: Diagnostics) -> None:
    """Add a reported change of state; the periodic reports have no key `state` and the stamp of their making."""
    state = diagnostics.value(status_names.ODOMETRY, Key.STATE)
    resets = status_names.count(diagnostics.value(status_names.ODOMETRY, Key.RESETS))
    if state in STATES and resets is not None:
        column.add(diagnostics.stamp_ns, (float(STATES.index(TrackingState(state))), float(resets)))


def _warnings(found: LogInfo, reader: RecordingReader, repeated: Mapping[str, int]) -> list[str]:
    """Return what is missing in the recording, one line each."""
    lines = []
    if found.state in (LogState.BROKEN, LogState.WRITTEN):
        lines.append(f"{found.path}: {found.state.value}: the messages up to byte {found.readable_bytes} are compared")
    if reader.corrupt:
        lines.append(f"{found.path}: {reader.corrupt} corrupt chunks or records are left out")
    lines += [
        f"{found.path}: {count} messages on {topic!r} cannot be read and are left out"
        for topic, count in reader.unreadable.items()
    ]
    lines += [
        f"{found.path}: {count} messages on {reader.topic_name(name)!r} repeat a stamp and are left out"
        for name, count in repeated.items()
        if count
    ]
    return lines
