"""What is in an MCAP log, of whatever make and in whatever state: topics, times, sizes, and whether it is whole."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Statistics

from drivers.logs.file_lock import is_locked
from drivers.logs.mcap_catalog import Catalog
from drivers.logs.mcap_index import has_footer, read_attachments, read_summary, summary_section
from drivers.logs.mcap_messages import DataSection
from drivers.logs.mcap_records import MAGIC, PARSE_ERRORS, LogFile, RecordError, parser, read_content, records


class LogState(Enum):
    """How a log is."""

    WHOLE = "whole"
    WRITTEN = "being written"
    UNINDEXED = "whole, but without an index"
    BROKEN = "cut or corrupt"


@dataclass(frozen=True, slots=True)
class LogInfo:
    """What a log holds."""

    path: Path
    size: int  # bytes
    state: LogState
    read: int  # bytes, up to where it is whole
    broken: int  # chunks and records within that are corrupt; of a whole log only its outline is looked at
    topics: Mapping[str, tuple[str, int]]  # topic -> type, '' where it is not CDR, and number of messages
    span_ns: tuple[int, int] | None  # of the times of logging; None without messages
    attachments: Mapping[str, int]  # name -> bytes; those that can be read, up to 32

    @property
    def messages(self) -> int:
        """How many there are."""
        return sum(count for _, count in self.topics.values())


def read_log_info(path: str | os.PathLike[str]) -> LogInfo:
    """What a log holds; one without an index is read through. DriverError where there is none."""
    written = is_locked(path)  # before it is looked at: it may end meanwhile
    file = LogFile(path)
    try:
        return _of_index(file, written) or _of_messages(file, written)
    finally:
        file.close()


def _of_index(file: LogFile, written: bool) -> LogInfo | None:
    """From the summary of a log that holds together to its end; None where there is no such summary."""
    summary, statistics = read_summary(file), _statistics(file)
    if summary is None or statistics is None:
        return None
    if not any(record.opcode == Opcode.DATA_END for record in records(file, len(MAGIC), file.size)):
        return None
    span_ns = (statistics.message_start_time, statistics.message_end_time) if statistics.message_count else None
    topics = _by_topic(summary.catalog, Counter(summary.message_counts))
    attachments = {name: len(data) for name, data in read_attachments(file, summary).items()}
    state = LogState.WRITTEN if written else LogState.WHOLE
    return LogInfo(file.path, file.size, state, file.size, 0, topics, span_ns, attachments)


def _statistics(file: LogFile) -> Statistics | None:
    section = summary_section(file)
    if section is not None:
        for record in records(section, 0, section.size):
            if record.opcode == Opcode.STATISTICS:
                try:
                    found: Statistics = Statistics.read(parser(read_content(section, record)))
                    return found
                except (RecordError, *PARSE_ERRORS):
                    return None
    return None


def _of_messages(file: LogFile, written: bool) -> LogInfo:
    section, counts = DataSection(file, Catalog()), Counter[int]()
    first_ns, last_ns = 2**64, -1
    for message in section.messages():
        counts[message.channel_id] += 1
        first_ns, last_ns = min(first_ns, message.log_time_ns), max(last_ns, message.log_time_ns)
    whole = section.ended and has_footer(file) and not section.broken
    state = LogState.WRITTEN if written else LogState.UNINDEXED if whole else LogState.BROKEN
    span_ns = (first_ns, last_ns) if last_ns >= 0 else None
    attachments = {name: len(data) for name, data in read_attachments(file, None).items()}
    topics = _by_topic(section.catalog, counts)
    return LogInfo(file.path, file.size, state, section.at, section.broken, topics, span_ns, attachments)


def _by_topic(catalog: Catalog, counts: Counter[int]) -> dict[str, tuple[str, int]]:
    """Messages of channels that nobody defined are left out: nothing can be made of them."""
    return {name: (kind, sum(counts[channel] for channel in catalog.ids(name)))
            for name, kind in sorted(catalog.topics().items())}
