"""What is compressed in logs: files, chunks of a file, single messages. Nothing unpacks without a bound."""

from __future__ import annotations

import bz2
import gzip
import os
import shutil
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from drivers.errors import DriverError, RecordError

MAX_RECORD_BYTES: Final = 256 * 2**20  # of a message, of an image and of an unpacked chunk, whatever a file states
PACKED_SUFFIXES: Final = (".zst", ".zstd", ".gz", ".bz2", ".lz4")
ZSTD: Final = b"\x28\xb5\x2f\xfd"  # first bytes of a frame (RFC 8878); no message begins with them
_FAULTS: Final = (OSError, EOFError, RuntimeError, ValueError, MemoryError, zlib.error, zstandard.ZstdError)


def _zstd(file: IO[bytes]) -> Any:
    return zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)


_OPENERS: Final[dict[bytes, Callable[[IO[bytes]], Any]]] = {
    ZSTD: _zstd,
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\x04\x22\x4d\x18": lz4.frame.open,
}


def unpack_chunk(compression: bytes, data: memoryview, size: int) -> bytes | memoryview:
    """Return the content of a chunk that states this size [bytes], at most one byte more; raise RecordError.

    compression: lz4, zstd, bz2 or nothing. The byte more lets the checksum behind the content be compared.
    """
    if size > MAX_RECORD_BYTES:
        raise RecordError(f"it unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
    try:
        match compression:
            case b"":
                return data[: size + 1]
            case b"lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
            case b"bz2":
                return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
            case b"zstd":
                return zstandard.ZstdDecompressor().stream_reader(data).read(size + 1)
    except _FAULTS as error:
        raise RecordError(f"it does not unpack: {error}") from error
    raise RecordError(f"its compression {compression!r} is unknown")


def is_packed_message(data: bytes | memoryview) -> bool:
    """True if rosbag2 has compressed this message by itself; its first bytes are enough."""
    return bytes(data[: len(ZSTD)]) == ZSTD


def unpack_message(data: memoryview) -> memoryview:
    """Return a message, unpacked where rosbag2 has compressed each message; raise RecordError where it is damaged."""
    if not is_packed_message(data):
        return data
    try:
        stated = zstandard.get_frame_parameters(data).content_size
    except zstandard.ZstdError as error:
        raise RecordError(f"it does not unpack: {error}") from error
    is_known = stated != zstandard.CONTENTSIZE_UNKNOWN
    unpacked = unpack_chunk(b"zstd", data, stated if is_known else MAX_RECORD_BYTES)
    if is_known and len(unpacked) != stated:
        raise RecordError(f"it unpacks to {len(unpacked)} of {stated} bytes")
    return memoryview(unpacked)


def is_packed(start: bytes) -> bool:
    """True if a file with these first bytes was compressed as a whole, as by `ros2 bag record` or gzip."""
    return start.startswith(tuple(_OPENERS))


@contextmanager
def scratch_folder(name: str, needed_bytes: int = 0) -> Iterator[Path]:
    """Make a folder on the disk for temporary files: in $TMPDIR, else in /var/tmp.

    Files that are open stay readable when it is removed. Raise DriverError where it cannot be made, or where the files
    would take more than half of the free space.
    """
    place = os.environ.get("TMPDIR") or "/var/tmp"
    try:
        if needed_bytes > shutil.disk_usage(place).free // 2:
            raise _too_small(name, place)
        with TemporaryDirectory(prefix="omnid-", dir=place) as folder:
            yield Path(folder)
    except OSError as error:
        raise DriverError(f"cannot unpack {name!r} in {place!r}: {error.strerror}; set TMPDIR") from error


def unpack_file(path: Path, folder: Path) -> Path:
    """Unpack a compressed file to a folder, as far as it can be, and return the result.

    Raise DriverError where it takes more than half of the free space.
    """
    target, block_bytes, left = folder / path.name, 1 << 20, shutil.disk_usage(folder).free // 2
    with path.open("rb") as file, target.open("wb") as unpacked:
        start = file.read(max(map(len, _OPENERS)))
        file.seek(0)
        stream = next(opener for magic, opener in _OPENERS.items() if start.startswith(magic))(file)
        block = start
        while block:
            try:
                block = stream.read1(block_bytes)  # read() loses what precedes a cut
            except _FAULTS:
                block = b""  # What follows is cut or corrupt: the reader of the unpacked log reports that.
            left -= len(block)
            if left < 0:
                raise _too_small(str(path), str(folder.parent))
            unpacked.write(block)
    return target


def _too_small(name: str, place: str) -> DriverError:
    return DriverError(f"cannot unpack {name!r}: it takes more than half of the free space of {place!r}; set TMPDIR")
