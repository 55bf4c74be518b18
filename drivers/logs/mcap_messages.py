"""The messages of an MCAP log, streamed in the order of the file."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

from mcap.opcode import Opcode

from drivers.logs.mcap_catalog import Catalog
from drivers.logs.mcap_records import (
    MAGIC,
    ByteSource,
    LogFile,
    Record,
    RecordError,
    read_content,
    records,
    records_of_chunk,
)

_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
# A channel is defined before its first message. Within this part of a log, some seconds of both cameras and a gyro,
# each topic has had one.
_SCAN_BYTES, _SCAN_MESSAGES = 64 * 2**20, 2000


class LogMessage(NamedTuple):
    """A message whose data is not yet read."""

    channel_id: int
    log_time_ns: int
    source: ByteSource
    record: Record  # position of the data in the source

    def data(self) -> memoryview:
        """Read the data; raise RecordError where it is not complete."""
        return read_content(self.source, self.record)


class DataSection:
    """The messages of a log in file order; their channels and schemas are added to the catalog.

    limit_bytes: offset at which reading stops, by default the end of the file.
    """

    def __init__(self, file: LogFile, catalog: Catalog, limit_bytes: int | None = None) -> None:
        self._file = file
        self._limit_bytes = file.size if limit_bytes is None else limit_bytes
        self.catalog = catalog
        self.ended = False  # True after the section's proper end was read
        self.broken = 0  # chunks and records that were skipped, as they cannot be read
        self.position = len(MAGIC)  # offset up to which the file was read

    def messages(self) -> Iterator[LogMessage]:
        """Yield all readable messages."""
        for record in records(self._file, len(MAGIC), self._file.size):
            if record.opcode == Opcode.DATA_END or record.offset > self._limit_bytes:
                self.ended = record.opcode == Opcode.DATA_END
                return
            self.position = record.offset + record.size
            if record.opcode == Opcode.CHUNK:
                yield from self._chunk(record)
            else:
                yield from self._single(self._file, record)

    def _chunk(self, record: Record) -> Iterator[LogMessage]:
        try:
            for chunk, inner in records_of_chunk(self._file, record):
                yield from self._single(chunk, inner)
        except RecordError:
            self.broken += 1

    def _single(self, source: ByteSource, record: Record) -> Iterator[LogMessage]:
        try:
            if record.opcode == Opcode.MESSAGE:
                yield _message(source, record)
            elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.catalog.add(record.opcode, read_content(source, record))
        except RecordError:
            self.broken += 1


def _message(source: ByteSource, record: Record) -> LogMessage:
    try:
        channel_id, _, log_time_ns, _ = _MESSAGE.unpack(source.read(record.offset, min(record.size, _MESSAGE.size)))
    except struct.error as error:
        raise RecordError(f"a message record of {record.size} bytes is too short") from error
    rest = Record(record.opcode, record.offset + _MESSAGE.size, record.size - _MESSAGE.size)
    return LogMessage(channel_id, log_time_ns, source, rest)


def scan_channels(file: LogFile) -> Catalog:
    """Return the channels that are defined at the start of a log, for logs without a summary."""
    section = DataSection(file, Catalog(), _SCAN_BYTES)
    for count, _ in enumerate(section.messages()):
        if count >= _SCAN_MESSAGES:
            break
    return section.catalog
