"""Copies records of one MCAP log into another, with new numbers for channels and schemas."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import Writer

from drivers.logs.mcap_index import summary_section
from drivers.logs.mcap_records import (
    PARSE_ERRORS,
    ByteSource,
    LogFile,
    Record,
    RecordError,
    parser,
    read_content,
    records,
    records_of_chunk,
)

_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_MAX_DEFINITIONS: Final = 4096
_MAX_DEFINITION_BYTES: Final = 64 * 2**20  # Limit of all definitions together, so that the memory is bounded.


class RecordCopier:
    """Copies records into a writer, with new numbers for channels and schemas; counts unreadable ones as broken."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._ids: dict[tuple[int, int], int] = {}  # (opcode, number in the log) -> number in the copy
        self._definitions: dict[tuple[int, int], bytes] = {}
        self._definition_bytes = 0
        self.messages = self.attachments = self.broken = 0
        self._copiers: dict[int, Callable[[memoryview], None]] = {
            Opcode.SCHEMA: self._schema,
            Opcode.CHANNEL: self._channel,
            Opcode.MESSAGE: self._message,
            Opcode.ATTACHMENT: self._attachment,
            Opcode.METADATA: self._metadata,
        }

    def copy_definitions(self, file: LogFile) -> None:
        """Copy channels and schemas from the summary, since the chunk that defines them may be lost."""
        section = summary_section(file)
        if section is not None:
            for record in records(section, 0, section.size):
                if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self.copy_record(section, record)

    def copy_chunk(self, file: LogFile, record: Record) -> None:
        """Copy the records of a chunk."""
        try:
            for chunk, inner in records_of_chunk(file, record):
                self.copy_record(chunk, inner)
        except RecordError:
            self.broken += 1

    def copy_record(self, source: ByteSource, record: Record) -> None:
        """Copy one record; those of an index are skipped, since the writer makes its own."""
        copy = self._copiers.get(record.opcode)
        if copy is None:
            return
        try:
            copy(read_content(source, record))
        except (RecordError, *PARSE_ERRORS):
            self.broken += 1

    def _schema(self, body: memoryview) -> None:
        schema = Schema.read(parser(body))
        if self._is_new(Opcode.SCHEMA, schema.id, body):
            number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._ids[Opcode.SCHEMA, schema.id] = number

    def _channel(self, body: memoryview) -> None:
        channel = Channel.read(parser(body))
        schema = self._ids.get((Opcode.SCHEMA, channel.schema_id)) if channel.schema_id else 0
        if schema is None:
            raise RecordError("a channel of an unknown schema")
        if self._is_new(Opcode.CHANNEL, channel.id, body):
            number = self._writer.register_channel(channel.topic, channel.message_encoding, schema, channel.metadata)
            self._ids[Opcode.CHANNEL, channel.id] = number

    def _is_new(self, opcode: int, number: int, body: memoryview) -> bool:
        """True if a definition is not yet copied; raise RecordError where there are too many."""
        definition = bytes(body)
        if self._definitions.get((opcode, number)) == definition:
            return False
        self._definition_bytes += len(body)
        if len(self._ids) >= _MAX_DEFINITIONS or self._definition_bytes > _MAX_DEFINITION_BYTES:
            raise RecordError(f"more than {_MAX_DEFINITIONS} channels and schemas, or {_MAX_DEFINITION_BYTES} bytes")
        self._definitions[opcode, number] = definition
        return True

    def _message(self, body: memoryview) -> None:
        channel, sequence, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(body)
        number = self._ids.get((Opcode.CHANNEL, channel))
        if number is None:
            raise RecordError("a message of an unknown channel")
        self._writer.add_message(number, log_time_ns, bytes(body[_MESSAGE.size :]), publish_time_ns, sequence)
        self.messages += 1

    def _attachment(self, body: memoryview) -> None:
        crc = int.from_bytes(body[-4:], "little")
        if crc and zlib.crc32(body[:-4]) != crc:
            raise RecordError("an attachment does not match its CRC")
        found = Attachment.read(parser(body))
        self._writer.add_attachment(found.create_time, found.log_time, found.name, found.media_type, found.data)
        self.attachments += 1

    def _metadata(self, body: memoryview) -> None:
        found = Metadata.read(parser(body))
        self._writer.add_metadata(found.name, found.metadata)
