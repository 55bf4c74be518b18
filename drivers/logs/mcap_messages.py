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
    unpack_chunk,
)

_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


class LogMessage(NamedTuple):
    """A message not yet read: where its bytes are."""

    channel_id: int
    log_time_ns: int
    source: ByteSource
    record: Record

    def data(self) -> memoryview:
        return read_content(self.source, self.record)


class DataSection:
    """The messages of a log in file order, whose definitions it adds to the catalog on the way.

    What cannot be read is skipped and counted in broken; at is the byte of the file reached, and ended tells, once the
    messages are through, whether that was the section's proper end.
    """

    def __init__(self, file: LogFile, catalog: Catalog, stop: int | None = None) -> None:
        self._file = file
        self._stop = file.size if stop is None else stop
        self.catalog = catalog
        self.ended = False
        self.broken = 0
        self.at = len(MAGIC)

    def messages(self) -> Iterator[LogMessage]:
        for record in records(self._file, len(MAGIC), self._file.size):
            if record.opcode == Opcode.DATA_END or record.at > self._stop:
                self.ended = record.opcode == Opcode.DATA_END
                return
            self.at = record.at + record.size
            if record.opcode == Opcode.CHUNK:
                yield from self._chunk(record)
            else:
                yield from self._single(self._file, record)

    def _chunk(self, record: Record) -> Iterator[LogMessage]:
        try:
            chunk = unpack_chunk(read_content(self._file, record))
        except RecordError:
            self.broken += 1
            return
        end = 0
        for inner in records(chunk, 0, chunk.size):
            end = inner.at + inner.size
            yield from self._single(chunk, inner)
        self.broken += end != chunk.size

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
        channel_id, _, log_time_ns, _ = _MESSAGE.unpack(source.read(record.at, min(record.size, _MESSAGE.size)))
    except struct.error as error:
        raise RecordError(f"a message record of {record.size} bytes is too short") from error
    rest = Record(record.opcode, record.at + _MESSAGE.size, record.size - _MESSAGE.size)
    return LogMessage(channel_id, log_time_ns, source, rest)


def scan_channels(file: LogFile, limit_bytes: int, limit_messages: int) -> Catalog:
    """The channels that the start of a log mentions, for logs without a summary."""
    section = DataSection(file, Catalog(), stop=limit_bytes)
    for count, _ in enumerate(section.messages()):
        if count >= limit_messages:
            break
    return section.catalog
