"""Damaged and malicious logs give only DriverError or valid frames, and need little memory."""

from __future__ import annotations

import gzip
import os
import random
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType

from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_records import MAGIC, LogFile
from tests.drivers.logs.mcap_logs import (
    BARE,
    Entry,
    pairs,
    write_log,
)

LAYOUTS: list[dict[str, Any]] = [
    {"compression": CompressionType.LZ4, "chunk_size": 700},
    {"compression": CompressionType.ZSTD, "chunk_size": 700},
    {"chunk_size": 700},
    {"use_chunking": False},
    BARE | {"chunk_size": 700},
]


def payloads(reader: LogReader) -> list[tuple[str, int, bytes]]:
    return [(frame.camera, frame.stamp_ns, bytes(frame.data)) for frame in reader.frames()]


def survivors(path: Path) -> tuple[list[tuple[str, int, bytes]], LogReader] | None:
    """Return the frames and the reader of a log that may be damaged, None where it is refused in one line."""
    try:
        reader = LogReader(path)
    except DriverError as error:
        assert str(error) and str(error).isprintable()
        return None
    try:
        reader.attachments()
        reader.pair_estimate()
        return payloads(reader), reader
    finally:
        reader.close()


def small_log(path: Path, layout: dict[str, Any]) -> tuple[bytes, list[tuple[str, int, bytes]]]:
    write_log(path, pairs(2), [("rig.toml", b"version = 1")], **layout)
    return path.read_bytes(), payloads(LogReader(path))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_a_truncated_log_gives_the_frames_before(tmp_path: Path, step: int, layout: dict[str, Any]) -> None:
    """Cut at every seventh byte: lengths and numbers of records have 2, 4 or 8 bytes."""
    path = tmp_path / "log.mcap"
    whole, expected = small_log(path, layout)
    counts = []
    for size in reversed(range(0, len(whole), step)):
        os.truncate(path, size)
        found = survivors(path)
        if found is not None:
            frames, reader = found
            assert frames == expected[: len(frames)]
            assert reader.truncated and "cut or corrupt" in reader.warnings[0]
        counts.append(0 if found is None else len(found[0]))
    assert counts == sorted(counts, reverse=True) and set(counts) >= {0, 2, 4}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_detects_flipped_bytes(tmp_path: Path, layout: dict[str, Any]) -> None:
    whole, expected = small_log(tmp_path / "whole.mcap", layout)
    path, chance = tmp_path / "flipped.mcap", random.Random(5)
    read = 0
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(chance.choice((1, 1, 1, 4))):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        path.write_bytes(data)
        found = survivors(path)
        read += found is not None
        if found is not None and layout.get("use_chunking", True):
            wrong = set(found[0]) - set(expected)
            assert not wrong, "a chunk's CRC protects every frame"
    assert read > 30


def test_refuses_noise_after_the_magic(tmp_path: Path) -> None:
    path, chance = tmp_path / "noise.mcap", random.Random(6)
    for _ in range(300):
        path.write_bytes(MAGIC + bytes([chance.randrange(16)]) + chance.randbytes(chance.randrange(400)))
        assert survivors(path) is None


@pytest.mark.parametrize("layout", LAYOUTS[:3])
def test_a_corrupt_chunk_costs_only_its_own_frames(tmp_path: Path, layout: dict[str, Any]) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(30), **layout)
    expected = payloads(LogReader(path))
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        place = make_reader(file).get_summary().chunk_indexes[9]  # type: ignore[union-attr]
    data[place.chunk_start_offset + place.chunk_length // 2] ^= 0x55
    path.write_bytes(data)
    found = survivors(path)
    assert found is not None
    frames, reader = found
    assert 55 <= len(frames) < 60 and set(frames) < set(expected)
    assert reader.counts["broken_records"] == 1 and not reader.truncated
    assert reader.warnings == ["skipped 1 corrupt chunks or records of the file"]


def test_a_corrupt_first_chunk_loses_no_channels(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(30), chunk_size=700)
    data = bytearray(path.read_bytes())
    data[data.index(b"frame_id")] ^= 0x55
    path.write_bytes(data)
    found = survivors(path)
    assert found is not None and 55 <= len(found[0]) < 60


def test_reports_a_corrupt_length(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(30), chunk_size=700)
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        place = make_reader(file).get_summary().chunk_indexes[9]  # type: ignore[union-attr]
    data[place.chunk_start_offset + 6] ^= 0x55
    path.write_bytes(data)
    found = survivors(path)
    assert found is not None and 8 <= len(found[0]) <= 20
    assert found[1].truncated and f"after byte {place.chunk_start_offset} of {len(data)}" in found[1].warnings[0]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "it is empty"),
        (MAGIC[:5], "starts with"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), r"starts with b'\\x89PNG"),
        (b"SQLite format 3\0" + bytes(50), "file is not a database"),
        (b"#ROSBAG V2.0\n" + bytes(50), "`omnid log info`"),
        (zstandard.compress(bytes(50)), "zstd -d"),
        (gzip.compress(bytes(50), mtime=0), "gzip -d"),  # else it holds the time, and names of tests must not
        (b"PK\x03\x04" + bytes(50), "unzip"),
        (MAGIC, "`omnid log info`"),
    ],
)
def test_refuses_other_files_in_one_line(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    with pytest.raises(DriverError, match=message) as caught:
        LogReader(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [(b"SQLite format 3\0", "rosbags-convert --src ITS_FOLDER"), (b"#ROSBAG V2.0\n", "rosbags-convert --src FILE")],
)
def test_tools_for_mcap_files_refuse_other_bags(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    with pytest.raises(DriverError, match=message):
        LogFile(path)


def test_refuses_unreadable_paths(tmp_path: Path) -> None:
    with pytest.raises(DriverError, match="No such file"):
        LogReader(tmp_path / "nowhere.mcap")
    with pytest.raises(DriverError, match="none"):
        LogReader(tmp_path)
    (tmp_path / "bag_0.db3").touch()
    with pytest.raises(DriverError, match="it is empty"):
        LogReader(tmp_path)
    with pytest.raises(DriverError, match=f"rosbags-convert --src {tmp_path} --dst"):
        LogFile(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(DriverError, match="no regular file"):
        LogReader(tmp_path / "pipe")


def chunk(compression: str, size: int, packed: bytes, crc: int = 0) -> bytes:
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


def bomb(name: str, pack: Callable[[bytes], bytes], size: int | None = None) -> bytes:
    """Return a chunk that becomes 400 MB, and says so or another size."""
    data = bytes(400 * 2**20)
    return chunk(name, len(data) if size is None else size, pack(data))


HOSTILE: dict[str, Callable[[], bytes]] = {
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


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).bytes(200_000)
    entries = [e._replace(data=e.data + noise) for e in pairs(100)]
    path = write_log(tmp_path / "log.mcap", entries, chunk_size=2**20)
    tracemalloc.start()
    try:
        count = sum(1 for _ in LogReader(path, window=4).frames())
        assert count == 200 and tracemalloc.get_traced_memory()[1] < 8 * 2**20 < path.stat().st_size
    finally:
        tracemalloc.stop()


def test_a_frame_does_not_keep_its_chunk_in_memory(tmp_path: Path) -> None:
    ballast = Entry("/ballast", "std_msgs/msg/String", bytes(2 * 2**20), 0)
    path = write_log(tmp_path / "log.mcap", [e for pair in pairs(10) for e in (ballast, pair)], chunk_size=2**21)
    tracemalloc.start()
    try:
        frames = list(LogReader(path).frames())
        assert len(frames) == 20 and tracemalloc.get_traced_memory()[0] < 2**20
    finally:
        tracemalloc.stop()
