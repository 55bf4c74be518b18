"""A run out of its recording: poses, states, commands, rig and settings; any MCAP with Odometry will do.

Images are passed over unread and a pose is kept in 64 bytes, so a recording may be as long as a working day.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from calib import se3
from drivers.logs.mcap_catalog import Catalog
from drivers.logs.mcap_index import read_attachments, read_summary
from drivers.logs.mcap_info import LogInfo, LogState, read_log_info
from drivers.logs.mcap_messages import DataSection, LogMessage
from drivers.logs.mcap_records import LogFile, RecordError
from omnid.errors import OmnidError
from omnid.recordings.series_differences import Series
from omnid.transport.codec import DIAGNOSTICS_SCHEMA, ODOMETRY_SCHEMA, TWIST_SCHEMA, odometry_from_cdr, twist_from_cdr
from omnid.transport.decode import decode_diagnostics

STATES: Final = ("tracking", "degraded", "lost")
MOST: Final = 1 << 20  # rows of a series: 9 hours of poses at 30 Hz
_NAME: Final = "omnid: odometry"
_LISTED: Final = 8

Row: TypeAlias = tuple[int, tuple[float, ...]]  # stamp and values


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What a recording says of a run."""

    path: Path
    topic: str  # of the poses
    poses: Series  # x y z [m], qx qy qz qw: T_odom_base
    states: Series  # number in STATES and reset counter, a row for each report of a change
    drive: Series  # what the wheels were told, m/s and rad/s
    attached: Mapping[str, bytes]
    warnings: tuple[str, ...]


def read_run(path: Path, topic: str | None = None) -> Run:
    """The run in a recording; topic: of the poses, where there are several with Odometry.

    DriverError where there is no log, OmnidError where it has no poses, or more than can be held.
    """
    found = read_log_info(path)
    odometry = _odometry_topic(found, topic)
    columns = {name: _Column(width) for name, width in (("poses", 7), ("states", 2), ("drive", 2))}
    robot = odometry.rpartition("/")[0]
    wanted = {odometry: _Reading(ODOMETRY_SCHEMA, _pose, columns["poses"]),
              f"{robot}/status": _Reading(DIAGNOSTICS_SCHEMA, _state, columns["states"]),
              f"{robot}/drive": _Reading(TWIST_SCHEMA, _drive, columns["drive"])}
    attached = _pass_through(found.path, wanted)
    poses = columns["poses"].series()
    if not poses.stamps_ns.size:
        raise OmnidError(f"{path}: topic {odometry!r} has no message that is a pose: is the recording cut?")
    return Run(found.path, odometry, poses, columns["states"].series(), columns["drive"].series(), attached,
               tuple(_warnings(found, wanted)))


def _odometry_topic(found: LogInfo, topic: str | None) -> str:
    names = [name for name, (kind, _) in found.topics.items() if kind == ODOMETRY_SCHEMA]
    if topic is not None:
        if topic not in names:
            raise OmnidError(f"{found.path}: no {ODOMETRY_SCHEMA} on {topic!r}: found {_listed(names)}; name another")
        return topic
    if len(names) == 1:
        return names[0]
    if names:
        raise OmnidError(f"{found.path}: several topics with poses: {_listed(names)}; give one of them with --topic")
    raise OmnidError(f"{found.path}: no {ODOMETRY_SCHEMA} in it: found {_listed(found.topics)}; images alone become "
                     f"a run by `omnid replay {found.path} --record out.mcap`")


def _listed(names: Iterable[str]) -> str:
    every = sorted(names)
    shown = ", ".join(ascii(name) for name in every[:_LISTED]) or "nothing"
    return shown + (f" and {len(every) - _LISTED} more" if len(every) > _LISTED else "")


class _Column:
    """Rows as they come, MOST of them at the most; of several with one stamp the first counts."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._stamps, self._values = array("q"), array("d")
        self.repeated = 0

    def add(self, stamp_ns: int, values: tuple[float, ...]) -> None:
        """Takes a row."""
        if len(self._stamps) >= MOST:
            raise OmnidError(f"a recording of more than {MOST} poses, states or commands: cut it into shorter ones")
        self._stamps.append(stamp_ns)
        self._values.extend(values)

    def series(self) -> Series:
        """The rows in the order of their stamps."""
        stamps_ns = np.frombuffer(self._stamps, np.int64) if self._stamps else np.empty(0, np.int64)
        values = np.frombuffer(self._values) if self._values else np.empty(0)
        kept, rows = np.unique(stamps_ns, return_index=True)  # the first of equals
        self.repeated = stamps_ns.size - kept.size
        return Series(kept, values.reshape(-1, self._width)[rows])


@dataclass(slots=True)
class _Reading:
    """How the messages of a topic become rows, and how many did not."""

    schema: str
    parse: Callable[[bytes], Row | None]
    column: _Column
    broken: int = 0

    def take(self, message: LogMessage) -> None:
        """Adds the row of a message, if it is one."""
        try:
            row = self.parse(bytes(message.data()))
        except (OmnidError, RecordError):
            self.broken += 1
            return
        if row is not None:
            self.column.add(*row)


def _pass_through(path: Path, wanted: Mapping[str, _Reading]) -> dict[str, bytes]:
    """Reads all that is wanted; gives what is attached."""
    file = LogFile(path)
    try:
        section = DataSection(file, Catalog())
        for message in section.messages():
            topic = section.catalog.topic(message.channel_id)
            reading = wanted.get(topic.name) if topic is not None else None
            if topic is not None and reading is not None and topic.type == reading.schema:
                reading.take(message)
        return read_attachments(file, read_summary(file))
    finally:
        file.close()


def _pose(payload: bytes) -> Row:
    record = odometry_from_cdr(payload)
    T = record.T_odom_base
    return record.stamp_ns, (*T[:3, 3].tolist(), *se3.quaternion(T[:3, :3]).tolist())


def _state(payload: bytes) -> Row | None:
    """What a report of a change says; None for one of those that come every second, stamped when they were made."""
    report = decode_diagnostics(payload)
    state, resets = report.value(_NAME, "state"), report.value(_NAME, "resets")
    if state not in STATES or not (resets.isascii() and resets.isdigit() and len(resets) < 10):
        return None
    return report.stamp_ns, (float(STATES.index(state)), float(resets))


def _drive(payload: bytes) -> Row:
    stamp_ns, _, velocity_mps, yaw_rate_radps = twist_from_cdr(payload)
    if not (math.isfinite(velocity_mps) and math.isfinite(yaw_rate_radps)):
        raise OmnidError(f"a command of {velocity_mps} m/s and {yaw_rate_radps} rad/s is none; check the sender")
    return stamp_ns, (velocity_mps, yaw_rate_radps)


def _warnings(found: LogInfo, wanted: Mapping[str, _Reading]) -> list[str]:
    """What makes a recording less than whole, one line each."""
    parts = []
    if found.state in (LogState.BROKEN, LogState.WRITTEN):
        parts.append(f"{found.path}: {found.state.value}: what is whole up to byte {found.readable_bytes} is compared")
    for topic, reading in wanted.items():
        if reading.broken:
            parts.append(f"{found.path}: {reading.broken} messages on {topic!r} are no {reading.schema}: left out")
        if reading.column.repeated:
            parts.append(f"{found.path}: {reading.column.repeated} messages on {topic!r} have a stamp that came "
                         "before: left out")
    return parts
