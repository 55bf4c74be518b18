"""The same content is read from every format: frames, order of time, contents; parts, damage and hostile files."""

from __future__ import annotations

import os
import random
import re
import struct
import tracemalloc
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType

from drivers.errors import DriverError, RecordError
from drivers.frame import Frame
from drivers.logs.log import unpack_message
from drivers.logs.log_reader import LogCameras, LogReader, open_log
from drivers.logs.mcap_file import MAGIC
from tests.drivers.logs.mcap_logs import (
    BARE,
    COMPRESSED,
    LOWER,
    START_NS,
    UPPER,
    Entry,
    compressed,
    jpeg,
    pairs,
    text,
    write_bag,
    write_db3,
    write_folders,
    write_killed_db3,
    write_log,
    write_zstd_mcap,
)

PAIRS = 12
Contents = list[tuple[str, int, int, bytes]]
Write = Callable[[Path, Sequence[Entry]], Path]


def mcap(**options: Any) -> Write:
    return lambda folder, entries: write_log(folder / "log.mcap", entries, [("rig.toml", b"version = 1")], **options)


SMALL: Final = {"chunk_size": 700}
# Format -> a function that writes entries to a folder and returns the path to open.
FORMATS: Final[dict[str, Write]] = {
    "mcap": mcap(**SMALL),
    "mcap, lz4": mcap(compression=CompressionType.LZ4, **SMALL),
    "mcap, zstd": mcap(compression=CompressionType.ZSTD, **SMALL),
    "mcap without index": mcap(**(BARE | SMALL)),
    "mcap without chunks": mcap(**(BARE | {"use_chunking": False})),
    "mcap, compressed messages": lambda folder, entries: write_zstd_mcap(folder / "log.mcap", entries),
    "db3": lambda folder, entries: write_db3(folder / "bag", entries).parent,
    "db3, compressed messages": lambda folder, entries: write_db3(folder / "bag", entries, zstd=True),
    "db3 of a killed recorder": lambda folder, entries: write_killed_db3(folder / "bag", entries),
    "bag": lambda folder, entries: write_bag(folder / "log.bag", entries),
    "bag, bz2": lambda folder, entries: write_bag(folder / "log.bag", entries, "BZ2"),
    "bag, lz4": lambda folder, entries: write_bag(folder / "log.bag", entries, "LZ4"),
    "folder": lambda folder, entries: write_folders(folder / "images", entries),
}
MCAP_LAYOUTS: Final = ("mcap", "mcap, lz4", "mcap, zstd", "mcap without index", "mcap without chunks")


def contents(frames: Sequence[Frame]) -> Contents:
    return [(frame.camera, frame.seq, frame.stamp_ns, bytes(frame.data)) for frame in frames]


def expected(count: int) -> Contents:
    """Return what is read of the pairs of images."""
    stamps = [START_NS + number * 10**8 for number in range(count)]
    cameras = (("lower", 0), ("upper", 10**6))
    return [(c, n, s + late, jpeg(s // 10**8)) for n, s in enumerate(stamps) for c, late in cameras]


def read(path: Path, **options: Any) -> tuple[Contents, LogReader]:
    with closing(LogReader(path, LogCameras(**options))) as reader:
        return contents(list(reader.frames())), reader


def survivors(path: Path) -> tuple[Contents, LogReader] | None:
    """Return the frames and the reader of a log that may be damaged, None where it is refused in one line."""
    try:
        with closing(LogReader(path)) as reader:
            reader.attachments()
            reader.pair_estimate()
            return contents(list(reader.frames())), reader
    except DriverError as error:
        assert str(error) and str(error).isprintable()
        return None


def is_one_fault(warnings: list[str]) -> bool:
    """True if one corrupt record is reported, with its place."""
    return [re.sub("byte [0-9].*", "byte", line) for line in warnings] == [
        "skipped 1 corrupt chunks or records of the file; the first: the chunk at byte"
    ]


# Whole logs


@pytest.mark.parametrize("name", FORMATS)
def test_frames_and_contents_are_the_same_in_every_format(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path, pairs(PAIRS))
    found, reader = read(path)
    assert found == expected(PAIRS)
    assert not reader.warnings and reader.counts["lower"] == PAIRS
    with closing(LogReader(path)) as again:
        assert again.pair_estimate() == PAIRS
        assert contents(list(again.frames())) == contents(list(again.frames())) == found
    with closing(open_log(path)) as log:
        assert log.counts() | {"/imu": 0} == dict.fromkeys(log.topics, PAIRS) | {"/imu": 0}
        assert {kind for topic, kind in log.topics.items() if topic != "/imu"} == {COMPRESSED}
        assert log.state == "whole" and log.size_bytes > 1000


@pytest.mark.parametrize("name", ["mcap", "db3", "bag"])
def test_a_log_that_was_written_camera_by_camera_is_read_in_the_order_of_time(tmp_path: Path, name: str) -> None:
    entries = sorted(pairs(60), key=lambda entry: entry.topic)
    found, reader = read(FORMATS[name](tmp_path, entries))
    assert found == expected(60) and not reader.warnings


# Folders and parts


@pytest.mark.parametrize("suffix", ["mcap", "db3", "bag"])
def test_the_parts_of_a_split_log_are_read_as_one(tmp_path: Path, suffix: str) -> None:
    folder, entries = tmp_path / "split", pairs(3 * 11)
    folder.mkdir()
    for part in range(11):  # more than ten: 10 follows 9, not 1
        some = entries[6 * part : 6 * part + 6]
        path = folder / f"bag_{part}.{suffix}"
        if suffix == "mcap":
            write_log(path, some)
        elif suffix == "bag":
            write_bag(path, some)
        else:
            write_db3(tmp_path / f"part{part}", some).rename(path)
    found, reader = read(folder)
    assert found == expected(33) and not reader.warnings
    assert open_log(folder).state == "whole"
    (folder / f"bag_5.{suffix}").unlink()
    with pytest.raises(DriverError, match="the numbered parts of one"):
        read(folder)


def test_omnids_own_recordings_of_one_run_are_parts(tmp_path: Path) -> None:
    """The last one was cut."""
    entries = pairs(6)
    write_log(tmp_path / "omnid_20261122T050000Z_001.mcap", entries[:4], [("rig.toml", b"one")])
    last = write_log(tmp_path / "omnid_20261122T051000Z_002.mcap", entries[4:], [("rig.toml", b"two")])
    last.write_bytes(last.read_bytes()[:-500])
    found, reader = read(tmp_path)
    assert len(found) > 4 and "_002.mcap" in reader.warnings[0]
    assert open_log(tmp_path).state == "cut or corrupt"
    with closing(LogReader(tmp_path)) as again:
        assert again.attachments() == {"rig.toml": b"one"}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "it is empty"),
        (MAGIC[:5], "starts with"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), r"starts with b'\\x89PNG"),
        (b"SQLite format 3\0" + bytes(50), "file is not a database"),
        (b"#ROSBAG V2.0\n" + bytes(50), "try `rosbag reindex`"),
        (zstandard.compress(MAGIC + bytes(50)), "unpacked if it was compressed"),
        (MAGIC, "`omnid log info`"),
        (MAGIC + bytes(4), "is cut or corrupt after byte 8 of 12$"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    with pytest.raises(DriverError, match=message) as caught:
        LogReader(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_unreadable_paths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DriverError, match="No such file"):
        LogReader(tmp_path / "nowhere.mcap")
    with pytest.raises(DriverError, match="none"):
        LogReader(tmp_path)
    (tmp_path / "bag_0.db3").touch()
    with pytest.raises(DriverError, match="it is empty"):
        LogReader(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(DriverError, match="no regular file"):
        LogReader(tmp_path / "pipe")


# Damage


@pytest.mark.parametrize("name", [*MCAP_LAYOUTS, "mcap, compressed messages"])
@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_a_truncated_log_gives_the_frames_before(tmp_path: Path, step: int, name: str) -> None:
    """Cut at every seventh byte: lengths and numbers of records have 2, 4 or 8 bytes."""
    path = FORMATS[name](tmp_path, pairs(2))
    counts = []
    for size in reversed(range(0, path.stat().st_size, step)):
        os.truncate(path, size)
        found = survivors(path)
        if found is not None:
            frames, reader = found
            assert frames == expected(2)[: len(frames)]
            assert "cut or corrupt after byte" in reader.warnings[0]
        counts.append(0 if found is None else len(found[0]))
    assert counts == sorted(counts, reverse=True) and set(counts) >= {0, 2, 4}


@pytest.mark.parametrize("name", ["mcap", "mcap without chunks"])
def test_a_log_that_is_truncated_while_it_is_read_gives_the_frames_that_are_left(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path, pairs(PAIRS))
    with closing(LogReader(path)) as reader:
        frames = reader.frames()
        first = next(frames)
        os.truncate(path, path.stat().st_size // 2)
        found = contents([first, *frames])
        assert 2 < len(found) < 2 * PAIRS and found == expected(PAIRS)[: len(found)]
        assert len(reader.warnings) == 1 and "corrupt chunks or records" in reader.warnings[0]


@pytest.mark.parametrize("name", [*MCAP_LAYOUTS, "bag, bz2", "db3"])
def test_flipped_bits_change_no_frame_of_a_chunk(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path, pairs(2))
    path = path if path.is_file() else next(path.glob("*.db3"))
    whole, chance, readable = path.read_bytes(), random.Random(5), 0
    for _ in range(150):
        data = bytearray(whole)
        for _ in range(chance.choice((1, 1, 1, 4))):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        path.write_bytes(data)
        found = survivors(path)
        readable += found is not None
        if found is not None and name not in ("mcap without chunks", "db3"):
            images = {(camera, stamp_ns, data) for camera, _, stamp_ns, data in expected(2)}
            assert {(camera, stamp_ns, data) for camera, _, stamp_ns, data in found[0]} <= images
    assert readable > 15


def test_a_cut_database_is_read_up_to_its_end(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "bag", pairs(60))
    os.truncate(path, int(0.7 * path.stat().st_size))
    found = survivors(path)
    assert found is not None
    assert 0 < len(found[0]) < 120 and "cut or corrupt" in found[1].warnings[0]
    assert open_log(path).state == "cut or corrupt"


@pytest.mark.parametrize("name", ["mcap", "db3"])
def test_other_topics_and_broken_messages_are_left_out(tmp_path: Path, name: str) -> None:
    noise = [Entry("/chatter", "std_msgs/msg/String", text("hello"), START_NS + n) for n in range(50)]
    junk = Entry(UPPER, COMPRESSED, b"\0\1\0\0junk", START_NS + 1)
    found, reader = read(FORMATS[name](tmp_path, [*noise, *pairs(4), junk]))
    assert found == expected(4) and reader.counts["broken"] == 1 and "no valid image" in reader.warnings[0]


# Chunks of MCAP files, hostile ones, attachments and topics

COMPRESSIONS: Final = (CompressionType.LZ4, CompressionType.ZSTD, CompressionType.NONE)


def chunk_at(path: Path, index: int) -> Any:
    with path.open("rb") as file:
        return make_reader(file).get_summary().chunk_indexes[index]  # type: ignore[union-attr]


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_corrupt_chunk_costs_only_its_own_frames(tmp_path: Path, compression: CompressionType) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(30), compression=compression, chunk_size=700)
    expected = read(path)[0]
    data, place = bytearray(path.read_bytes()), chunk_at(path, 9)
    data[place.chunk_start_offset + place.chunk_length // 2] ^= 0x55
    path.write_bytes(data)
    found = survivors(path)
    assert found is not None
    frames, reader = found
    lost = {frame[2:] for frame in expected} - {frame[2:] for frame in frames}
    assert len(frames) + len(lost) == 60 and 1 <= len(lost) <= 5
    assert open_log(path).state == "cut or corrupt"
    assert reader.counts["broken_records"] == 1
    assert is_one_fault(reader.warnings)


def chunk(compression: str, size: int, packed: bytes, crc: int = 0) -> bytes:
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


def bomb(name: str, pack: Callable[[bytes], bytes]) -> bytes:
    """Return a chunk that becomes 400 MB, and states a smaller size."""
    return chunk(name, 1000, pack(bytes(400 * 2**20)))


HOSTILE: Final[dict[str, Callable[[], bytes]]] = {
    "a record longer than the file": lambda: struct.pack("<BQ", 6, 2**62),
    "a schema longer than the file": lambda: struct.pack("<BQHI", 3, 6, 1, 2**32 - 1),
    "a chunk's inner length": lambda: struct.pack("<BQQQQIIQ", 6, 40, 0, 0, 10, 0, 0, 2**63 + 5),
    "an lz4 size": lambda: chunk("lz4", 2**40, lz4.frame.compress(b"x" * 99)),
    "an lz4 bomb": lambda: bomb("lz4", lz4.frame.compress),
    "a zstd bomb": lambda: bomb("zstd", zstandard.compress),
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
        assert found is None or "is cut" in found[1].warnings[0] or found[1].counts["broken_records"] == 1
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


@pytest.mark.parametrize("compression", ["LZ4", pytest.param("BZ2", marks=pytest.mark.slow)])
def test_a_chunk_of_a_bag_unpacks_to_a_bounded_size(tmp_path: Path, compression: str) -> None:
    huge = Entry(LOWER, COMPRESSED, compressed(START_NS, bytes(270 * 2**20)), START_NS)
    path = write_bag(tmp_path / "log.bag", [*pairs(2), huge], compression, chunk_bytes=100)
    assert path.stat().st_size < 4 * 2**20
    found, reader = read(path)
    assert found == expected(2) and is_one_fault(reader.warnings)


def test_chunks_of_a_bag_that_share_an_index_are_refused(tmp_path: Path) -> None:
    """They would list any number of messages."""
    path = write_bag(tmp_path / "log.bag", pairs(PAIRS))
    data = path.read_bytes()
    info, count = data[data.rindex(b"op=\x06") - 8 :], data.index(b"chunk_count=") + len(b"chunk_count=")
    path.write_bytes(data[:count] + struct.pack("<I", 1001) + data[count + 4 :] + info * 1000)
    with pytest.raises(DriverError, match="index has more bytes than the file"):
        LogReader(path)


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).bytes(200_000)
    entries = [entry._replace(data=compressed(entry.log_time_ns, jpeg(1) + noise)) for entry in pairs(100)]
    entries.sort(key=lambda entry: entry.topic)
    path = write_log(tmp_path / "log.mcap", entries, chunk_size=2**20)
    tracemalloc.start()
    try:
        count = sum(1 for _ in LogReader(path).frames())
        assert count == 200 and tracemalloc.get_traced_memory()[1] < 16 * 2**20 < path.stat().st_size
    finally:
        tracemalloc.stop()


# Attachments and topics


def test_a_corrupt_attachment_and_a_corrupt_summary_are_ignored(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2), [("rig.toml", b"version = 1"), ("other", b"2")])
    path.write_bytes(path.read_bytes().replace(b"version = 1", b"version = 7"))
    assert LogReader(path).attachments() == {"other": b"2"}
    data = bytearray(path.read_bytes())
    data[data.rindex(LOWER.encode()) + 1] ^= 1
    path.write_bytes(data)
    reader = LogReader(path)
    assert reader.topics == {"lower": LOWER, "upper": UPPER}


# Folders of images with stamps, one folder for each camera


STEP_NS = 10**8
NUMBERS = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize(
    "name", [str, lambda stamp_ns: f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"], ids=["nanoseconds", "seconds"]
)
def test_names_are_nanoseconds_or_seconds_with_a_decimal_point(tmp_path: Path, suffix: str, name: object) -> None:
    folder = write_folders(tmp_path / "images", pairs(PAIRS), name, suffix)  # type: ignore[arg-type]
    found, reader = read(folder)
    assert [frame[:3] for frame in found] == [frame[:3] for frame in expected(PAIRS)] and not reader.warnings


@pytest.mark.parametrize("where", ["lower", ""])
@pytest.mark.parametrize("name", ["times.txt", "timestamps.txt"])
def test_a_list_holds_the_seconds_of_numbered_images(tmp_path: Path, where: str, name: str) -> None:
    """In the order of numbers, 10 after 9; the seconds are exact."""
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp_ns: f"frame{NUMBERS[stamp_ns]}")
    lines = ["# seconds", "1.7e+09", *(f"1700000000.{number:02d}{number:07d}" for number in range(1, PAIRS))]
    for camera in ["lower", "upper"] if where else [""]:
        (folder / camera / name).write_text("\r\n".join(lines) + "\n", "utf-8-sig")  # as editors of Windows do
    found, _ = read(folder)
    assert [frame[2] for frame in found if frame[0] == "lower"] == [START_NS + 10_000_001 * n for n in range(PAIRS)]
    assert [frame[3] for frame in found if frame[0] == "lower"] == [frame[3] for frame in expected(PAIRS)[::2]]
    (folder / (where or ".") / name).write_text("1.0\n")
    with pytest.raises(DriverError, match="12 images, and its list of stamps 1 lines"):
        LogReader(folder)


@pytest.mark.parametrize("name", ["frame0", "0000000001", "1_0.5", "1.2.3", "9" * 30])
def test_a_name_that_is_no_stamp_is_refused_and_names_the_list(tmp_path: Path, name: str) -> None:
    folder = write_folders(tmp_path / "images", pairs(1), lambda _: name)
    with pytest.raises(DriverError, match=r"has no stamp: .*times\.txt"):
        LogReader(folder)
