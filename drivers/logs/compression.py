"""What is compressed in logs: chunks of a file, and single messages. Nothing unpacks without a bound."""

from __future__ import annotations

from typing import Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from drivers.errors import RecordError

MAX_RECORD_BYTES: Final = 256 * 2**20  # of a message, of an image and of an unpacked chunk, whatever a file states
ZSTD: Final = b"\x28\xb5\x2f\xfd"  # first bytes of a frame (RFC 8878); no message begins with them
_FAULTS: Final = (OSError, EOFError, RuntimeError, ValueError, MemoryError, zstandard.ZstdError)


def unpack_chunk(compression: bytes, data: memoryview, size: int) -> bytes | memoryview:
    """Return the content of a chunk that states this size [bytes], at most one byte more; raise RecordError.

    compression: lz4, zstd or nothing. The byte more lets the checksum behind the content be compared.
    """
    if size > MAX_RECORD_BYTES:
        raise RecordError(f"it unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
    try:
        match compression:
            case b"":
                return data[: size + 1]
            case b"lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
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
