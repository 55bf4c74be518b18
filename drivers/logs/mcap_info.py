"""Contents of an MCAP log from any writer, complete or damaged: topics, times, sizes, state."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from mcap.opcode import Opcode

from drivers.logs.file_lock import is_locked
from drivers.logs.mcap_catalog import Catalog
from drivers.logs.mcap_index import has_footer, read_attachments, read_summary
from drivers.logs.mcap_messages import DataSection
from drivers.logs.mcap_records import MAGIC, LogFile, records


class LogState(Enum):
    """State of a log file; the values are shown to the user."""

    WHOLE = "whole"
    WRITTEN = "being written"
    UNINDEXED = "whole, but without an index"
    BROKEN = "cut or corrupt"


@dataclass(frozen=True, slots=True)
class LogInfo:
    """Contents of a log."""

    path: Path
    size_bytes: int
    state: LogState
    readable_bytes: int  # length up to which the file could be read
    broken: int  # corrupt chunks and records in that length; of a log with an index the chunks are not checked
    topics: Mapping[str, tuple[str, int]]  # topic -> type ('' where it is not CDR), number of messages
    span_ns: tuple[int, int] | None  # first and last log time; None without messages
    attachments: Mapping[str, int]  # name -> bytes of the readable ones, up to 32

    @property
    def messages(self) -> int:
        """Number of messages of all topics."""
        return sum(count for _, count in self.topics.values())


def read_log_info(path: str | os.PathLike[str]) -> LogInfo:
    """Return the contents of a log; a log without an index is read to its end. Raise DriverError without a log."""
    locked = is_locked(path)  # before it is read: the writer may end in the meantime
    file = LogFile(path)
    try:
        return _from_index(file, locked) or _from_messages(file, locked)
    finally:
        file.close()


def _from_index(file: LogFile, locked: bool) -> LogInfo | None:
    """Return the contents by the summary; None without a summary, or where the data section has no end."""
    summary = read_summary(file)
    if summary is None or summary.statistics is None:
        return None
    if not any(record.opcode == Opcode.DATA_END for record in records(file, len(MAGIC), file.size)):
        return None
    statistics = summary.statistics
    span_ns = (statistics.message_start_time, statistics.message_end_time) if statistics.message_count else None
    topics = _by_topic(summary.catalog, Counter(summary.message_counts))
    attachments = {name: len(data) for name, data in read_attachments(file, summary).items()}
    state = LogState.WRITTEN if locked else LogState.WHOLE
    return LogInfo(file.path, file.size, state, file.size, 0, topics, span_ns, attachments)


def _from_messages(file: LogFile, locked: bool) -> LogInfo:
    """Return the contents by reading all messages."""
    section, counts = DataSection(file, Catalog()), Counter[int]()
    first_ns, last_ns = 2**64, -1
    for message in section.messages():
        counts[message.channel_id] += 1
        first_ns, last_ns = min(first_ns, message.log_time_ns), max(last_ns, message.log_time_ns)
    complete = section.ended and has_footer(file) and not section.broken
    unlocked = LogState.UNINDEXED if complete else LogState.BROKEN
    state = LogState.WRITTEN if locked else unlocked
    span_ns = (first_ns, last_ns) if last_ns >= 0 else None
    attachments = {name: len(data) for name, data in read_attachments(file, None).items()}
    topics = _by_topic(section.catalog, counts)
    return LogInfo(file.path, file.size, state, section.position, section.broken, topics, span_ns, attachments)


def _by_topic(catalog: Catalog, counts: Counter[int]) -> dict[str, tuple[str, int]]:
    """Return topic -> type and number of messages; messages of undefined channels are left out."""
    return {
        name: (kind, sum(counts[channel] for channel in catalog.ids(name)))
        for name, kind in sorted(catalog.topics().items())
    }
