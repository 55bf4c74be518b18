"""Recovery of truncated or corrupt logs: readable records are copied to a new log with an index and a summary."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Header
from mcap.writer import CompressionType, Writer

from drivers.errors import DriverError
from drivers.logs.file_lock import is_locked, lock
from drivers.logs.mcap_index import has_footer, read_summary, summary_section
from drivers.logs.mcap_record_copier import RecordCopier
from drivers.logs.mcap_records import (
    MAGIC,
    PARSE_ERRORS,
    LogFile,
    Record,
    RecordError,
    parser,
    read_content,
    records,
)

_COMPRESSIONS = {b"lz4": CompressionType.LZ4, b"zstd": CompressionType.ZSTD}
_CHUNK_BYTES: Final = 2**20
_MAX_SEARCHED: Final = 10_000  # records at the start that are searched for the first chunk
_COMPRESSION_OFFSET: Final = 28  # in a chunk record: after three numbers of 8 bytes and one of 4
_MAX_COMPRESSION_NAME: Final = 4  # bytes, of the names known here


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of a recovery."""

    messages: int  # copied
    attachments: int  # copied
    lost: int | None  # messages; None where the log has no statistics
    broken: int  # chunks and records that were skipped
    end: int  # offset up to which the log could be read [bytes]
    whole: bool  # the log was complete and valid


def recover(path: str | os.PathLike[str], out: str | os.PathLike[str]) -> Recovery:
    """Copy all readable records of an MCAP log to a new file, in the same order and with the same compression.

    Streams: the memory holds at most a few chunks, whatever the size and the damage of the log. Raises DriverError,
    and leaves no file, where `path` is no log, is being written or contains nothing readable, and where `out` exists
    or cannot be written.
    """
    if is_locked(path):
        raise DriverError(f"cannot recover {str(path)!r}: it is being written; stop the recording first")
    file = LogFile(path)
    try:
        target = _created(Path(out))
        try:
            lock(target)
            return _written(file, target, Path(out))
        finally:
            with suppress(OSError):  # of a file that a full disk has ended; a complete one has reached the disk
                target.close()
    finally:
        file.close()


def _created(out: Path) -> IO[bytes]:
    try:
        return out.open("xb")
    except FileExistsError as error:
        raise DriverError(
            f"cannot write {str(out)!r}: it exists and is not overwritten; name another file by -o"
        ) from error
    except OSError as error:
        raise DriverError(f"cannot write {str(out)!r}: {error.strerror}; name another file by -o") from error


def _written(file: LogFile, target: IO[bytes], out: Path) -> Recovery:
    """Copy to an open target; delete it where it cannot be completed."""
    try:
        found = _copied(file, target)
        if not (found.messages or found.attachments):
            raise DriverError(f"nothing in {str(file.path)!r} can be recovered: no message and no attachment is valid")
        return found
    except OSError as error:
        out.unlink(missing_ok=True)
        raise DriverError(f"cannot write {str(out)!r}: {error.strerror}; free the disk or name another") from error
    except BaseException:
        out.unlink(missing_ok=True)
        raise


def _copied(file: LogFile, target: IO[bytes]) -> Recovery:
    """Copy the readable records, and compare their number with the log's own statistics."""
    header = _header(file)
    writer = Writer(target, _CHUNK_BYTES, _compression(file))
    writer.start(header.profile, header.library)
    copier, source = RecordCopier(writer), _RecoverableRecords(file)
    copier.copy_definitions(file)
    for record in source.records():
        if record.opcode == Opcode.CHUNK:
            copier.copy_chunk(file, record)
        else:
            copier.copy_record(file, record)
    writer.finish()  # type: ignore[no-untyped-call]
    target.flush()
    os.fsync(target.fileno())
    summary = read_summary(file)
    known = sum(summary.message_counts.values()) if summary else 0
    lost = max(0, known - copier.messages) if known else None
    whole = source.ended and not (source.skips or copier.broken or lost) and summary is not None and has_footer(file)
    return Recovery(
        copier.messages, copier.attachments, 0 if whole else lost, copier.broken + source.skips, source.end, whole
    )


def _header(file: LogFile) -> Header:
    """Return the header of the log, an empty one where it is unreadable."""
    first = next(records(file, len(MAGIC), file.size), None)
    if first is not None and first.opcode == Opcode.HEADER and first.size < _CHUNK_BYTES:
        try:
            header: Header = Header.read(parser(read_content(file, first)))
            return header
        except (RecordError, *PARSE_ERRORS):
            pass
    return Header("", "")


def _compression(file: LogFile) -> CompressionType:
    """Return the compression of the first chunk."""
    for count, record in enumerate(records(file, len(MAGIC), file.size)):
        if record.opcode == Opcode.CHUNK:
            size = int.from_bytes(file.read(record.offset + _COMPRESSION_OFFSET, 4), "little")
            start = record.offset + _COMPRESSION_OFFSET + 4
            return _COMPRESSIONS.get(file.read(start, min(size, _MAX_COMPRESSION_NAME)), CompressionType.NONE)
        if count >= _MAX_SEARCHED:
            break
    return CompressionType.NONE


class _RecoverableRecords:
    """The records of a log's data section; after a record with a wrong length, from the next indexed chunk on."""

    def __init__(self, file: LogFile) -> None:
        self._file = file
        self._chunks = _indexed_chunks(file)
        self.ended = False  # True after the section's proper end
        self.skips = 0  # times that bytes were skipped
        self.end = len(MAGIC)  # offset up to which the log was read

    def records(self) -> Iterator[Record]:
        """Yield all records that can be found; their content may still be invalid."""
        start: int | None = len(MAGIC)
        while start is not None:
            yield from self._contiguous(start)
            start = None if self.ended else self._next_chunk(max(start, self.end))
            self.skips += start is not None

    def _contiguous(self, start: int) -> Iterator[Record]:
        """Yield records up to the first one with a wrong length."""
        for record in records(self._file, start, self._file.size):
            end = record.offset + record.size
            if (self._next_chunk(record.offset) or end) < end:
                return  # its length is wrong: no record overlaps a chunk
            self.ended = record.opcode == Opcode.DATA_END
            if self.ended:
                return
            self.end = end
            yield record

    def _next_chunk(self, after: int) -> int | None:
        index = bisect_right(self._chunks, after)
        return self._chunks[index] if index < len(self._chunks) else None


def _indexed_chunks(file: LogFile) -> list[int]:
    """Return the offsets of the chunks by the summary, none without a summary."""
    section, offsets = summary_section(file), []
    if section is not None:
        for record in records(section, 0, section.size):
            if record.opcode == Opcode.CHUNK_INDEX:
                with suppress(RecordError, *PARSE_ERRORS):
                    offsets.append(int(ChunkIndex.read(parser(read_content(section, record))).chunk_start_offset))
    return sorted(offsets)
