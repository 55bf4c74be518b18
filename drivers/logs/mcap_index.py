"""The summary at the end of an MCAP log: topics, message counts, attachments."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Statistics

from drivers.logs.mcap_catalog import Catalog
from drivers.logs.mcap_records import (
    MAGIC,
    PARSE_ERRORS,
    RECORD_HEADER,
    ByteBuffer,
    LogFile,
    Record,
    RecordError,
    parser,
    read_content,
    records,
)

MAX_ATTACHMENT_BYTES = 16 * 2**20
MAX_ATTACHMENTS = 32
MAX_ALL_ATTACHMENTS_BYTES = 64 * 2**20
_MAX_SUMMARY_BYTES = 64 * 2**20
_MAX_NAME = 256  # characters
_MAX_ATTACHMENT_HEAD_BYTES = 1024  # times, name and media type of an attachment
_CRC_BYTES = 4

_FOOTER = struct.Struct("<QQI")  # summary start, summary offset start, CRC of the summary and of the footer before it


@dataclass(frozen=True, slots=True)
class LogSummary:
    """The summary of a complete log."""

    catalog: Catalog
    message_counts: Mapping[int, int]  # by channel
    statistics: Statistics | None  # None: the log has none
    attachments: tuple[int, ...] = field(repr=False)  # offsets of their records


def read_summary(file: LogFile) -> LogSummary | None:
    """Return the summary of a log, None where the file is truncated, has no summary, or the summary's CRC is wrong."""
    section = summary_section(file)
    if section is None:
        return None
    catalog, attachments = Catalog(), list[int]()
    found: list[Statistics] = []
    try:
        for record in records(section, 0, section.size):
            body = read_content(section, record)
            if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                catalog.add(record.opcode, body)
            elif record.opcode == Opcode.STATISTICS:
                found.append(Statistics.read(parser(body)))
            elif record.opcode == Opcode.ATTACHMENT_INDEX and len(attachments) < MAX_ATTACHMENTS:
                attachments.append(AttachmentIndex.read(parser(body)).offset)
    except (RecordError, *PARSE_ERRORS):
        return None
    counts = Counter[int]()
    for statistics in found:
        counts.update(statistics.channel_message_counts)
    return LogSummary(catalog, counts, found[0] if found else None, tuple(attachments))


def has_footer(file: LogFile) -> bool:
    """True if the file ends with the footer of a complete log."""
    return _footer(file) is not None


def _footer(file: LogFile) -> bytes | None:
    size = RECORD_HEADER.size + _FOOTER.size
    end = file.read(max(0, file.size - size - len(MAGIC)), size + len(MAGIC))
    if len(end) < size + len(MAGIC) or not end.endswith(MAGIC):
        return None
    return end[:size] if RECORD_HEADER.unpack_from(end) == (Opcode.FOOTER, _FOOTER.size) else None


def summary_section(file: LogFile) -> ByteBuffer | None:
    """Return the records of the summary, None where read_summary returns None."""
    footer = _footer(file)
    if footer is None:
        return None
    start, _, crc = _FOOTER.unpack_from(footer, RECORD_HEADER.size)
    size = file.size - len(MAGIC) - len(footer) - start
    if not start or not 0 < size <= _MAX_SUMMARY_BYTES:
        return None
    section = file.read(start, size)
    if len(section) < size or (crc and zlib.crc32(section + footer[:-_CRC_BYTES]) != crc):
        return None
    return ByteBuffer(section)


def read_attachments(file: LogFile, summary: LogSummary | None) -> dict[str, bytes]:
    """Return name -> bytes of the valid attachments within the limits; without a summary, those before the messages."""
    found: dict[str, bytes] = {}
    left = MAX_ALL_ATTACHMENTS_BYTES
    indexed = None if summary is None else _records_at(file, summary.attachments)
    for record in indexed or records(file, len(MAGIC), file.size):
        if record.opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END) or len(found) >= MAX_ATTACHMENTS:
            break
        largest = min(left, MAX_ATTACHMENT_BYTES + _MAX_ATTACHMENT_HEAD_BYTES)
        if record.opcode == Opcode.ATTACHMENT and record.size <= largest:
            left -= record.size
            found.update(_attachment(file, record))
    return found


def _records_at(file: LogFile, offsets: tuple[int, ...]) -> Iterator[Record]:
    for offset in offsets:
        record = next(records(file, offset, file.size), None)
        if record is not None and record.opcode == Opcode.ATTACHMENT:
            yield record


def _attachment(file: LogFile, record: Record) -> dict[str, bytes]:
    """Return name -> bytes of one attachment, empty where it is malformed, too large or its CRC is wrong."""
    try:
        body = read_content(file, record)
        attachment = Attachment.read(parser(body))
    except (RecordError, *PARSE_ERRORS):
        return {}
    crc = int.from_bytes(body[-_CRC_BYTES:], "little")
    if (crc and zlib.crc32(body[:-_CRC_BYTES]) != crc) or len(attachment.data) > MAX_ATTACHMENT_BYTES:
        return {}
    return {attachment.name[:_MAX_NAME]: attachment.data}
