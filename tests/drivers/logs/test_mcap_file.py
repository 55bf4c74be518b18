"""MCAP files that are corrupt or malicious: what is lost, and how much memory they need; attachments and topics."""

from __future__ import annotations

import os
import struct
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType
from rosbags.rosbag1 import Reader

from drivers.errors import RecordError
from drivers.logs import record_file
from drivers.logs.compression import unpack_message
from drivers.logs.log_reader import LogReader
from drivers.logs.open_log import open_log
from drivers.logs.record_file import MCAP_MAGIC as MAGIC
from tests.drivers.logs.bags import write_bag
from tests.drivers.logs.mcap_logs import IMAGE, LOWER, UPPER, Entry, compressed, jpeg, pairs, write_log
from tests.drivers.logs.test_formats import is_one_fault, read, survivors

COMPRESSIONS: Final = (CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE)


def chunk_at(path: Path, index: int) -> Any:
    with path.open("rb") as file:
        return make_reader(file).get_summary().chunk_indexes[index]  # type: ignore[union-attr]


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("index", [0, 9])
def test_a_corrupt_chunk_costs_only_its_own_frames(tmp_path: Path, compression: CompressionType, index: int) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(30), compression=compression, chunk_size=700)
    expected = read(path)[0]
    data, place = bytearray(path.read_bytes()), chunk_at(path, index)
    data[place.chunk_start_offset + place.chunk_length // 2] ^= 0x55
    path.write_bytes(data)
    found = survivors(path)
    assert found is not None
    frames, reader = found
    lost = {frame[2:] for frame in expected} - {frame[2:] for frame in frames}
    assert len(frames) + len(lost) == 60
    assert 1 <= len(lost) <= 5
    assert reader.counts["broken_records"] == 1 and not reader.truncated
    assert is_one_fault(reader.warnings)


@pytest.mark.parametrize("hole", [(6, 1), (0, 64), (300, 1200)], ids=["a length", "a head", "parts of two chunks"])
@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_behind_a_hole_reading_goes_on_at_the_next_chunk(tmp_path: Path, hole: tuple[int, int], kind: str) -> None:
    """As a page of the disk that was not written."""
    if kind == "mcap":
        path = write_log(tmp_path / "log.mcap", pairs(30), chunk_size=700)
        begin = chunk_at(path, 9).chunk_start_offset
    else:
        path = write_bag(tmp_path / "log.bag", pairs(30), chunk_bytes=1400)
        with Reader(path) as bag:
            begin = sorted(chunk.pos for chunk in bag.chunk_infos)[9]
    expected, data, (offset, size) = read(path)[0], bytearray(path.read_bytes()), hole
    start = begin + offset
    data[start : start + size] = bytes([data[start] ^ 0x55]) if size == 1 else bytes(size)
    path.write_bytes(data)
    found = survivors(path)
    assert found is not None and 52 <= len(found[0]) < 60
    assert {frame[2] for frame in found[0]} < {frame[2] for frame in expected}  # a bag has no checksums
    assert found[1].counts["broken_records"] >= 1 and not found[1].truncated


def chunk(compression: str, size: int, packed: bytes, crc: int = 0) -> bytes:
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


def bomb(name: str, pack: Callable[[bytes], bytes], size: int | None = None) -> bytes:
    """Return a chunk that becomes 400 MB, and says so or another size."""
    data = bytes(400 * 2**20)
    return chunk(name, len(data) if size is None else size, pack(data))


HOSTILE: Final[dict[str, Callable[[], bytes]]] = {
    "a record longer than the file": lambda: struct.pack("<BQ", 6, 2**62),
    "a record 200 MB longer than the file": lambda: struct.pack("<BQ", 6, 200 * 2**20),
    "a schema longer than the file": lambda: struct.pack("<BQHI", 3, 6, 1, 2**32 - 1),
    "a chunk's inner length": lambda: struct.pack("<BQQQQIIQ", 6, 40, 0, 0, 10, 0, 0, 2**63 + 5),
    "an lz4 size": lambda: chunk("lz4", 2**40, lz4.frame.compress(b"x" * 99)),
    "a zstd size": lambda: chunk("zstd", 2**40, zstandard.compress(b"x" * 99)),
    "an lz4 bomb": lambda: bomb("lz4", lz4.frame.compress, 1000),
    "a zstd bomb": lambda: bomb("zstd", zstandard.compress, 1000),
    "an lz4 bomb with its true size": lambda: bomb("lz4", lz4.frame.compress),
    "a zstd bomb with its true size": lambda: bomb("zstd", zstandard.compress),
    "a message in a chunk": lambda: chunk("", 31, struct.pack("<BQHIQQ", 5, 2**61, 1, 0, 0, 0)),
    "an unknown compression": lambda: chunk("rar", 5, b"12345"),
    "a message without its head": lambda: struct.pack("<BQH", 5, 2, 1),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_wrong_lengths_need_no_memory(tmp_path: Path, name: str) -> None:
    whole = write_log(tmp_path / "log.mcap", pairs(2)).read_bytes()
    path = tmp_path / "hostile.mcap"
    at = len(MAGIC) + 9 + struct.unpack_from("<Q", whole, len(MAGIC) + 1)[0]
    path.write_bytes(whole[:at] + HOSTILE[name]() + whole[at:])
    tracemalloc.start()
    try:
        found = survivors(path)
        assert found is None or found[1].truncated or found[1].counts["broken_records"] == 1
        assert tracemalloc.get_traced_memory()[1] < 8 * 2**20
    finally:
        tracemalloc.stop()


def test_a_compressed_message_unpacks_to_a_bounded_size() -> None:
    assert bytes(unpack_message(memoryview(zstandard.compress(b"x" * 5000)))) == b"x" * 5000
    stream = zstandard.ZstdCompressor(write_content_size=False).compress(b"y" * 99)
    assert bytes(unpack_message(memoryview(stream))) == b"y" * 99
    for damaged in (zstandard.compress(b"x" * 5000)[:-3], b"\x28\xb5\x2f\xfd", zstandard.compress(bytes(300 * 2**20))):
        with pytest.raises(RecordError, match="unpack"):
            unpack_message(memoryview(damaged))


@pytest.mark.parametrize("order", ["as taken", "camera by camera"])
def test_memory_does_not_grow_with_the_log(tmp_path: Path, order: str) -> None:
    noise = np.random.default_rng(0).bytes(200_000)
    entries = [entry._replace(data=compressed(entry.log_time_ns, jpeg(1) + noise)) for entry in pairs(100)]
    if order == "camera by camera":
        entries.sort(key=lambda entry: entry.topic)
    path = write_log(tmp_path / "log.mcap", entries, chunk_size=2**20)
    tracemalloc.start()
    try:
        count = sum(1 for _ in LogReader(path).frames())
        assert count == 200 and tracemalloc.get_traced_memory()[1] < 16 * 2**20 < path.stat().st_size
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_before_the_first_image_only_heads_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    noise = np.random.default_rng(0).bytes(50_000)
    entries = [entry._replace(data=compressed(entry.log_time_ns, jpeg(1) + noise)) for entry in pairs(100)]
    write: Callable[[Path, list[Entry]], Path] = write_bag if kind == "bag" else write_log
    path, read_bytes, pread = write(tmp_path / f"log.{kind}", entries), [0], os.pread

    def counted(fd: int, size: int, offset: int) -> bytes:
        read_bytes[0] += size
        return pread(fd, size, offset)

    monkeypatch.setattr("os.pread", counted)
    with closing(LogReader(path)) as reader:
        next(reader.frames())
        assert read_bytes[0] < path.stat().st_size / 4


# Attachments and topics


@pytest.mark.parametrize("with_summary", [True, False])
def test_bounds_the_memory_of_all_attachments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_summary: bool
) -> None:
    monkeypatch.setattr(record_file, "MAX_ALL_ATTACHMENTS_BYTES", 5000)
    files = [(str(number), bytes(2000)) for number in range(4)] + [("rig.toml", b"version = 1")]
    path = write_log(tmp_path / "log.mcap", pairs(2), files)
    if not with_summary:
        path.write_bytes(path.read_bytes()[:-9])
    assert LogReader(path).attachments().keys() == {"0", "1", "rig.toml"}


def test_ignores_a_corrupt_attachment_and_a_corrupt_summary(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2), [("rig.toml", b"version = 1"), ("other", b"2")])
    path.write_bytes(path.read_bytes().replace(b"version = 1", b"version = 7"))
    assert LogReader(path).attachments() == {"other": b"2"}
    data = bytearray(path.read_bytes())
    data[data.rindex(LOWER.encode()) + 1] ^= 1
    path.write_bytes(data)
    reader = LogReader(path)
    assert reader.topics == {"lower": LOWER, "upper": UPPER}


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def schema(number: int, name: str) -> bytes:
    return record(Opcode.SCHEMA, struct.pack("<H", number) + text(name) + text("ros2msg") + struct.pack("<I", 0))


def channel(number: int, schema_id: int, topic: str, encoding: str = "cdr") -> bytes:
    body = struct.pack("<HH", number, schema_id) + text(topic) + text(encoding) + struct.pack("<I", 0)
    return record(Opcode.CHANNEL, body)


def topics_of(path: Path, records: bytes) -> dict[str, str]:
    path.write_bytes(MAGIC + records)
    with closing(open_log(path)) as log:
        return dict(log.topics())


def test_topics_have_types_that_can_be_decoded_and_their_names_are_bounded(tmp_path: Path) -> None:
    encodings = ((10, 1, "cdr"), (11, 1, "ros1"), (12, 2, "ros1"), (13, 1, "json"), (14, 9, "cdr"))
    known = schema(1, IMAGE) + schema(2, "std_msgs/String")
    known += b"".join(channel(number, kind, f"/{number}", encoding) for number, kind, encoding in encodings)
    expected = {"/10": IMAGE, "/11": IMAGE, "/12": "std_msgs/msg/String", "/13": ""}
    assert topics_of(tmp_path / "log.mcap", known) == expected
    malformed = record(Opcode.CHANNEL, b"\1\0\xff\xff\xff\xff") + record(Opcode.SCHEMA, b"\1\0\xff\xff\xff\xff")
    assert topics_of(tmp_path / "log.mcap", malformed + schema(2, "") + channel(1, 2, "x" * 1000)) == {"x" * 256: ""}
    many = b"".join(channel(number, 1, f"/{number}") for number in range(5000))
    assert len(topics_of(tmp_path / "log.mcap", schema(1, IMAGE) + many)) == 4096
