"""The same content reads alike in every format: frames, order of time, contents; parts, damage and hostile files."""

from __future__ import annotations

import bz2
import fcntl
import gzip
import os
import random
import re
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.writer import CompressionType

from drivers.errors import DriverError
from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from drivers.logs.open_log import LogInfo, LogState, log_info, logs_in, open_log
from drivers.logs.record_file import MCAP_MAGIC as MAGIC
from drivers.logs.topics import MotionTopics
from drivers.motion import GyroSample
from tests.drivers.logs.bags import (
    unclosed_bag,
    write_bag,
    write_db3,
    write_folders,
    write_interrupted_db3,
    write_killed_db3,
    write_ros1_mcap,
    write_zstd_mcap,
)
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
    write_log,
)

PAIRS = 12
Contents = list[tuple[str, int, int, bytes]]
Write = Callable[[Path, Sequence[Entry]], Path]


def mcap(**options: Any) -> Write:
    return lambda folder, entries: write_log(folder / "log.mcap", entries, [("rig.toml", b"version = 1")], **options)


PACKERS: Final[dict[str, Callable[[bytes], bytes]]] = {
    # Of two frames, as parallel programs write them.
    ".zst": lambda data: zstandard.compress(data[:1000]) + zstandard.compress(data[1000:]),
    ".zstd": zstandard.compress,
    ".gz": gzip.compress,
    ".bz2": bz2.compress,
    ".lz4": lz4.frame.compress,
}


def packed(path: Path, suffix: str) -> Path:
    """Compress a file as a whole."""
    result = path.with_name(path.name + suffix)
    result.write_bytes(PACKERS[suffix](path.read_bytes()))
    path.unlink()
    return result


SMALL: Final = {"chunk_size": 700}
# Format -> a function that writes entries to a folder and returns the path to open.
FORMATS: Final[dict[str, Write]] = {
    "mcap": mcap(),
    "mcap, lz4": mcap(compression=CompressionType.LZ4, **SMALL),
    "mcap, zstd": mcap(compression=CompressionType.ZSTD, **SMALL),
    "mcap, small chunks": mcap(**SMALL),
    "mcap without chunks": mcap(use_chunking=False),
    "mcap without index": mcap(**(BARE | SMALL)),
    "mcap without both": mcap(**(BARE | {"use_chunking": False})),
    "mcap, compressed messages": lambda folder, entries: write_zstd_mcap(folder / "log.mcap", entries),
    "mcap of ROS 1": lambda folder, entries: write_ros1_mcap(folder / "log.mcap", entries),
    "db3": lambda folder, entries: write_db3(folder / "bag", entries).parent,
    "db3 without metadata": lambda folder, entries: write_db3(folder / "bag", entries).rename(folder / "log.db3"),
    "db3, compressed messages": lambda folder, entries: write_db3(folder / "bag", entries, zstd=True),
    "db3 of a killed recorder": lambda folder, entries: write_killed_db3(folder / "bag", entries),
    "bag": lambda folder, entries: write_bag(folder / "log.bag", entries),
    "bag, bz2": lambda folder, entries: write_bag(folder / "log.bag", entries, "BZ2"),
    "bag, lz4": lambda folder, entries: write_bag(folder / "log.bag", entries, "LZ4"),
    "mcap.zstd": lambda folder, entries: packed(write_log(folder / "log.mcap", entries), ".zstd"),
    "db3.zstd": lambda folder, entries: packed(write_db3(folder / "bag", entries), ".zstd"),
    "bag.zst": lambda folder, entries: packed(write_bag(folder / "log.bag", entries), ".zst"),
    "bag.gz": lambda folder, entries: packed(write_bag(folder / "log.bag", entries), ".gz"),
    "bag.bz2": lambda folder, entries: packed(write_bag(folder / "log.bag", entries), ".bz2"),
    "mcap.lz4": lambda folder, entries: packed(write_log(folder / "log.mcap", entries), ".lz4"),
    "folder": lambda folder, entries: write_folders(folder / "images", entries),
}
PACKED: Final = [name for name in FORMATS if name.endswith(tuple(PACKERS))]
OTHER_MCAP: Final = ("mcap", "mcap of ROS 1", *PACKED)
MCAP_LAYOUTS: Final = [name for name in FORMATS if name.startswith("mcap") and name not in OTHER_MCAP]
CHUNKED: Final = [*MCAP_LAYOUTS, *(name for name in FORMATS if name.startswith("bag") and name not in PACKED)]
WITHOUT_INDEX: Final = ("mcap without index", "mcap without both")


def contents(frames: Sequence[Frame]) -> Contents:
    return [(frame.camera, frame.seq, frame.stamp_ns, bytes(frame.data)) for frame in frames]


def expected(count: int) -> Contents:
    """Return what is read of the pairs of images."""
    stamps = [START_NS + number * 10**8 for number in range(count)]
    cameras = (("lower", 0), ("upper", 10**6))
    return [(c, n, s + late, jpeg(s // 10**8)) for n, s in enumerate(stamps) for c, late in cameras]


def read(path: Path, **options: Any) -> tuple[Contents, LogReader]:
    with closing(LogReader(path, **options)) as reader:
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
    """True if a corrupt record is told, and where it is."""
    return [re.sub("byte [0-9].*", "byte", line) for line in warnings] == [
        "skipped 1 corrupt chunks or records of the file; the first: the chunk at byte"
    ]


# Whole logs


@pytest.mark.parametrize("name", FORMATS)
def test_frames_and_contents_are_the_same_in_every_format(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path, pairs(PAIRS))
    found, reader = read(path)
    assert found == expected(PAIRS)
    assert not reader.warnings and not reader.truncated and reader.counts["lower"] == PAIRS
    with closing(LogReader(path)) as again:
        assert again.pair_estimate() == PAIRS
        assert contents(list(again.frames())) == contents(list(again.frames())) == found
    info: LogInfo = log_info(path)
    images = {topic: entry for topic, entry in info.topics.items() if topic != "/imu"}
    assert [*images.values()] == [(COMPRESSED, PAIRS)] * 2
    assert info.span_ns == (START_NS, START_NS + (PAIRS - 1) * 10**8 + 10**6)
    assert info.state is (LogState.UNINDEXED if name in WITHOUT_INDEX else LogState.WHOLE)
    assert info.size_bytes > 1000 and info.broken == 0 and not info.fault


@pytest.mark.parametrize("order", ["camera by camera", "backwards", "shuffled"])
@pytest.mark.parametrize("name", [name for name in FORMATS if name != "folder"])
def test_a_log_is_read_in_the_order_of_time_however_it_was_written(tmp_path: Path, name: str, order: str) -> None:
    """As by a writer that put all images of one camera first."""
    entries = pairs(60)
    if order == "camera by camera":
        entries.sort(key=lambda entry: entry.topic)
    elif order == "backwards":
        entries.reverse()
    else:
        random.Random(4).shuffle(entries)
    found, reader = read(FORMATS[name](tmp_path, entries))
    assert found == expected(60) and not reader.warnings


def test_an_mcap_of_ros1_has_the_samples_of_its_imu(tmp_path: Path) -> None:
    path = write_ros1_mcap(tmp_path / "log.mcap", pairs(2))
    with closing(LogReader(path, motion=MotionTopics(imu="/imu"))) as reader:
        samples = [message for message in reader.messages() if not isinstance(message, Frame)]
    assert samples == [GyroSample(100 * 10**9, 0.1, 0.2, 0.3)]


def test_a_log_that_is_written_says_so(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2))
    with path.open("rb") as file:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX)
        assert log_info(path).state is LogState.WRITTEN
    assert log_info(path).state is LogState.WHOLE


def test_a_growing_database_is_read_as_far_as_it_is_written(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "bag", pairs(2))
    with closing(sqlite3.connect(path)) as writer, closing(open_log(path)) as log:
        writer.execute("PRAGMA journal_mode = WAL")
        rows = writer.execute("SELECT topic_id, timestamp, data FROM messages").fetchall()
        for _ in range(200):
            writer.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
        writer.commit()
        assert len(list(log.messages())) == 4 * 201 and not log.damage().cut


def test_a_closed_database_in_a_folder_that_cannot_be_written_is_read_by_any_user(tmp_path: Path) -> None:
    with TemporaryDirectory() as place:
        path = Path(shutil.copy(write_db3(tmp_path / "bag", pairs(PAIRS)), place))
        with closing(sqlite3.connect(path)) as writer:
            writer.execute("PRAGMA journal_mode = WAL")
        Path(place).chmod(0o555)
        child = os.fork()
        if child == 0:  # as another user than root, who may write everywhere
            try:
                if os.getuid() == 0:
                    os.setuid(65534)
                os._exit(read(path)[0] != expected(PAIRS))
            finally:
                os._exit(2)
        assert os.waitpid(child, 0)[1] == 0
        Path(place).chmod(0o755)


def test_a_message_of_an_unknown_connection_is_told(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(PAIRS))
    data = bytearray(path.read_bytes())
    at = data.rindex(b"conn=", 0, data.rindex(b"\xff\xd8\xff")) + len(b"conn=")  # of the last image
    data[at] = 77
    path.write_bytes(data)
    found, reader = read(path)
    assert len(found) == 2 * PAIRS - 1 and "the channel 77 of messages is unknown" in reader.warnings[0]


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
    assert log_info(folder).messages == 66 and log_info(folder).state is LogState.WHOLE
    (folder / f"bag_5.{suffix}").unlink()
    found, reader = read(folder)
    assert len(found) == 60 and reader.truncated and len(reader.warnings) == 1
    assert f"are missing: bag_5.{suffix}: used the others" in reader.warnings[0]


def test_parts_that_were_written_camera_by_camera_are_read_in_the_order_of_time(tmp_path: Path) -> None:
    entries = sorted(pairs(60), key=lambda entry: entry.topic)
    for part in range(6):
        write_log(tmp_path / f"bag_{part}.mcap", entries[20 * part :][:20], **SMALL)
    found, reader = read(tmp_path)
    assert found == expected(60) and not reader.warnings


METADATA: Final = "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n{}\n  message_count: 24\n"


@pytest.mark.parametrize("missing", [None, 0, 1, 2])
@pytest.mark.parametrize("suffix", ["", ".zstd"])
def test_parts_that_metadata_lists_but_are_not_there_are_named(
    tmp_path: Path, missing: int | None, suffix: str
) -> None:
    entries = pairs(12)
    names = [f"bag_{number}.mcap{suffix}" for number in range(3)]
    for number in range(3):
        path = write_log(tmp_path / f"bag_{number}.mcap", entries[8 * number :][:8])
        if suffix:
            packed(path, suffix)
        if number == missing:
            (tmp_path / names[number]).unlink()
    (tmp_path / "metadata.yaml").write_text(METADATA.format("\n".join(f"    - {name}" for name in names)))
    found, reader = read(tmp_path)
    assert len(found) == (24 if missing is None else 16)
    lines = [] if missing is None else [f"are missing: {names[missing]}: used the others"]
    assert len(reader.warnings) == len(lines) and all(line in reader.warnings[0] for line in lines)
    assert log_info(tmp_path).state is (LogState.WHOLE if missing is None else LogState.BROKEN)


def test_a_compressed_file_is_read_up_to_its_cut(tmp_path: Path) -> None:
    path = packed(write_log(tmp_path / "log.mcap", pairs(60)), ".gz")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    found, reader = read(path)
    assert found == expected(60)[: len(found)] and len(found) > 60 and reader.truncated and len(reader.warnings) == 1


def test_a_cut_before_the_images_of_one_camera_is_named(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", sorted(pairs(20), key=lambda entry: entry.topic), **SMALL)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    with pytest.raises(DriverError, match=r"found only .* is cut or corrupt after byte"):
        LogReader(path)


def test_a_summary_without_schemas_is_no_index(tmp_path: Path) -> None:
    assert read(mcap(repeat_schemas=False)(tmp_path, pairs(PAIRS)))[0] == expected(PAIRS)


def test_a_part_that_was_unpacked_or_completed_is_read_once(tmp_path: Path) -> None:
    for suffix in ("", ".zstd"):
        for number in range(2):
            path = write_log(tmp_path / f"bag_{number}.mcap", pairs(4)[4 * number :][:4])
            if suffix:
                packed(path, suffix)
                write_log(path, pairs(4)[4 * number :][:4])
    assert read(tmp_path)[0] == expected(4)


def test_a_file_that_unpacks_to_more_than_the_disk_holds_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = packed(write_log(tmp_path / "log.mcap", pairs(2)), ".zstd")
    monkeypatch.setattr("shutil.disk_usage", lambda _: SmallDisk(3000))
    with pytest.raises(DriverError, match=r"more than half of the free space .* set TMPDIR"):
        LogReader(path)


class SmallDisk(NamedTuple):
    free: int


def test_omnids_own_recordings_of_one_run_are_parts(tmp_path: Path) -> None:
    """The last one was cut; one that is being written, or was completed since, is not read, or not twice."""
    entries = pairs(6)
    first = write_log(tmp_path / "omnid_20261122T050000Z_001.mcap", entries[:4], [("rig.toml", b"one")])
    last = write_log(tmp_path / "omnid_20261122T051000Z_002.mcap.part", entries[4:], [("rig.toml", b"two")])
    last.write_bytes(last.read_bytes()[:-500])
    found, reader = read(tmp_path)
    assert len(found) > 4 and reader.truncated and "_002.mcap.part" in reader.warnings[0]
    assert log_info(tmp_path).state is LogState.BROKEN
    with closing(LogReader(tmp_path)) as again:
        assert again.attachments() == {"rig.toml": b"one"}
    with last.open("rb") as writer:
        fcntl.flock(writer.fileno(), fcntl.LOCK_EX)
        assert logs_in(tmp_path) == [first]
    write_log(last.with_suffix(""), entries[4:])
    assert len(logs_in(tmp_path)) == 2 and read(tmp_path)[0] == expected(6)


def test_recordings_of_two_runs_are_not_one_log(tmp_path: Path) -> None:
    """Of the first run the oldest files are gone, by the limit of their number."""
    write_log(tmp_path / "omnid_20260202T023000Z_002.mcap", pairs(2))
    write_log(tmp_path / "omnid_20260203T023000Z_001.mcap", pairs(2))
    with pytest.raises(DriverError, match="give one file"):
        LogReader(tmp_path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "it is empty"),
        (MAGIC[:5], "starts with"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), r"starts with b'\\x89PNG"),
        (b"SQLite format 3\0" + bytes(50), "file is not a database"),
        (b"#ROSBAG V2.0\n" + bytes(50), "`omnid log info`"),
        (b"\x28\xb5\x2f\xfd" + bytes(50), "is compressed, but cut or corrupt"),
        (b"\x1f\x8b" + bytes(50), "is compressed, but cut or corrupt"),
        (zstandard.compress(b"PK\x03\x04" + bytes(50)), r"starts with b'PK"),
        (MAGIC, "`omnid log info`"),
        (MAGIC + bytes(4), "is cut or corrupt after byte 8 of 12$"),
    ],
)
def test_refuses_other_files_in_one_line(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    with pytest.raises(DriverError, match=message) as caught:
        LogReader(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_refuses_unreadable_paths(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("name", CHUNKED)
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
            assert reader.truncated and "cut or corrupt after byte" in reader.warnings[0]
        counts.append(0 if found is None else len(found[0]))
    assert counts == sorted(counts, reverse=True) and set(counts) >= (
        {0, 4} if name in ("bag, bz2", "bag, lz4") else {0, 2, 4}
    )


def test_a_cut_mcap_that_was_written_topic_by_topic_is_read_in_the_order_of_time(tmp_path: Path) -> None:
    entries = sorted(pairs(60), key=lambda entry: entry.topic)
    path = write_log(tmp_path / "log.mcap", entries, **SMALL)
    os.truncate(path, path.stat().st_size - 100)  # its index is gone
    found, reader = read(path)
    assert found == expected(60) and reader.truncated


def mutated(data: bytes, chance: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(chance.randint(1, 12)):
        at = chance.randrange(len(changed))
        changed[at : at + 1] = chance.choice([bytes([chance.randrange(256)]), b"", b"\xff" * 4, bytes(8)])
        changed = changed or bytearray(b"x")
    return bytes(changed[: chance.randint(1, len(changed))]) if chance.random() < 0.2 else bytes(changed)


@pytest.mark.parametrize("name", [*MCAP_LAYOUTS, "db3 without metadata", "bag, lz4"])
def test_damaged_logs_give_frames_or_one_line(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path, pairs(4))
    whole, chance = path.read_bytes(), random.Random(5)
    refused = complete = 0
    for _ in range(150):
        path.write_bytes(mutated(whole, chance))
        found = survivors(path)
        refused += found is None
        complete += found is not None and len(found[0]) == 8
    assert refused and (complete or name.startswith("mcap"))


@pytest.mark.parametrize("name", [*MCAP_LAYOUTS, "bag, bz2"])
def test_flipped_bits_change_no_frame_of_a_chunk(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path, pairs(2))
    whole, chance, readable = path.read_bytes(), random.Random(5), 0
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(chance.choice((1, 1, 1, 4))):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        path.write_bytes(data)
        found = survivors(path)
        readable += found is not None
        if found is not None and "without chunks" not in name and "without both" not in name:
            images = {(camera, stamp_ns, data) for camera, _, stamp_ns, data in expected(2)}
            assert {(camera, stamp_ns, data) for camera, _, stamp_ns, data in found[0]} <= images
    assert readable > 30


@pytest.mark.parametrize("open_chunk", [False, True])
def test_an_unclosed_bag_is_read_to_its_end(tmp_path: Path, open_chunk: bool) -> None:
    path = unclosed_bag(write_bag(tmp_path / "log.bag", pairs(PAIRS)), open_chunk=open_chunk)
    for source in (path, tmp_path):
        found, reader = read(source)
        assert found == expected(PAIRS) and len(reader.warnings) == 1 and "cut or corrupt" in reader.warnings[0]
        assert log_info(source).state is LogState.BROKEN and log_info(source).messages == 2 * PAIRS


def test_a_corrupt_chunk_of_a_bag_costs_its_own_frames(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(1), "BZ2")
    path.write_bytes(path.read_bytes().replace(b"BZh9", b"BZh0"))
    found, reader = read(path)
    assert found == [] and is_one_fault(reader.warnings)


def test_a_transaction_that_was_not_ended_is_undone(tmp_path: Path) -> None:
    """The journal lies beside the file, which is not changed."""
    path = write_interrupted_db3(tmp_path / "bag", pairs(PAIRS))
    before = path.read_bytes()
    found, reader = read(path)
    assert found == expected(PAIRS) and not reader.warnings and path.read_bytes() == before
    assert log_info(path).state is LogState.WHOLE


def test_a_cut_database_that_was_written_topic_by_topic_is_read_in_the_order_of_time(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "bag", sorted(pairs(60), key=lambda entry: entry.topic))
    os.truncate(path, int(0.9 * path.stat().st_size))
    found, reader = read(path)
    stamps = [frame[2] for frame in found]
    assert (
        len(found) > 90
        and stamps == sorted(stamps)
        and {frame[2:] for frame in found} < {frame[2:] for frame in expected(60)}
    )
    assert "cut or corrupt" in reader.warnings[0]


@pytest.mark.parametrize("name", ["mcap, lz4", "mcap, zstd"])
def test_the_content_of_a_log_is_examined(tmp_path: Path, name: str) -> None:
    path = FORMATS[name](tmp_path, pairs(PAIRS))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x55
    path.write_bytes(data)
    found = log_info(path, examine=True)
    assert found.state is LogState.BROKEN and found.broken == 1 and found.messages < 2 * PAIRS


def test_images_without_an_end_are_told_when_a_log_is_examined(tmp_path: Path) -> None:
    whole = pairs(3)
    half = [entry._replace(data=compressed(entry.log_time_ns, jpeg(1)[:-40])) for entry in whole[:2]]
    path = write_log(tmp_path / "log.mcap", [*half, *whole[2:]])
    found = log_info(path, examine=True)
    assert found.state is LogState.BROKEN and f"1 images of '{LOWER}' end too early" in found.fault
    assert log_info(write_log(path, whole), examine=True).state is LogState.WHOLE


@pytest.mark.parametrize("part", [0.5, 0.8])
def test_a_cut_database_is_read_up_to_its_end(tmp_path: Path, part: float) -> None:
    path = write_db3(tmp_path / "bag", pairs(60))
    os.truncate(path, int(part * path.stat().st_size))
    found = survivors(path)
    assert found is not None
    assert 0 < len(found[0]) < 120 and found[1].truncated and "cut or corrupt" in found[1].warnings[0]
    assert log_info(path).state is LogState.BROKEN


@pytest.mark.parametrize("part", [0.6, 0.8])
def test_behind_a_page_of_a_database_that_was_not_written_reading_goes_on(tmp_path: Path, part: float) -> None:
    path = write_db3(tmp_path / "bag", pairs(60))
    data, page = bytearray(path.read_bytes()), 4096
    at = int(part * len(data)) // page * page
    data[at : at + page] = bytes(page)
    path.write_bytes(data)
    found, reader = read(path)
    assert 100 < len(found) < 120 and {frame[2:] for frame in found} < {frame[2:] for frame in expected(60)}
    assert len(reader.warnings) == 1 and re.search(r"rows \d+ to \d+ of the table messages", reader.warnings[0])
    assert log_info(path).state is LogState.BROKEN and not reader.truncated


def test_a_part_that_was_written_twice_is_read_once(tmp_path: Path) -> None:
    """Its times go back, and no clock was set."""
    entries = pairs(20)
    found, reader = read(write_log(tmp_path / "log.mcap", entries[:20] + entries[10:], **SMALL))
    assert found == expected(20) and not reader.warnings


def test_a_file_behind_another_one_is_told(tmp_path: Path) -> None:
    first, second = (write_log(tmp_path / f"{n}.mcap", pairs(20)[20 * n :][:20]).read_bytes() for n in range(2))
    path = tmp_path / "both.mcap"
    path.write_bytes(first + second)
    found, reader = read(path)
    assert found == expected(10) and reader.truncated and "cut or corrupt after byte" in reader.warnings[0]


def test_a_write_ahead_log_that_is_cut_within_a_transaction_is_told(tmp_path: Path) -> None:
    path = write_killed_db3(tmp_path / "bag", pairs(60))
    log = Path(f"{path}-wal")
    os.truncate(log, log.stat().st_size // 2)
    assert "is cut within a transaction" in log_info(path).fault and log_info(path).state is LogState.BROKEN


@pytest.mark.parametrize("head", [b"", bytes(4096)], ids=["empty", "zeros"])
def test_a_database_whose_first_page_is_only_in_its_write_ahead_log_is_read(tmp_path: Path, head: bytes) -> None:
    """As where power failed before the recorder's first checkpoint."""
    with (
        closing(sqlite3.connect(tmp_path / "made.db3")) as bag,
        closing(sqlite3.connect(write_db3(tmp_path / "bag", pairs(PAIRS)))) as whole,
    ):
        bag.execute("PRAGMA journal_mode = WAL")
        bag.execute("PRAGMA wal_autocheckpoint = 0")
        bag.executescript("\n".join(whole.iterdump()))
        bag.commit()
        path = tmp_path / "killed" / "bag_0.db3"
        path.parent.mkdir()
        shutil.copy(tmp_path / "made.db3-wal", f"{path}-wal")
    path.write_bytes(head)
    found, reader = read(path)
    assert found == expected(PAIRS) and not reader.warnings and path.read_bytes() == head
    assert log_info(path.parent).state is LogState.WHOLE


@pytest.mark.parametrize("kept", ["no index", "the index of one topic"])
def test_an_index_that_lacks_messages_costs_none(tmp_path: Path, kept: str) -> None:
    """mcap's own reader delivers them all; the records of an index have the opcode 7."""
    path = write_log(tmp_path / "log.mcap", pairs(PAIRS), chunk_size=700)
    data, at, left = path.read_bytes(), len(MAGIC), 0
    changed = bytearray(data)
    while data[at] != 0x0F:  # the end of the data
        left = 0 if data[at] == 6 else left + (data[at] == 7)
        if data[at] == 7 and (kept == "no index" or left == 2):
            changed[at] = 0x80  # a private record
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    path.write_bytes(changed)
    found, reader = read(path)
    assert found == expected(PAIRS) and not reader.warnings


SQL_OF_OTHER_TABLES: Final = {
    "no bag": ["DROP TABLE messages"],
    "columns in another order": [
        "DROP TABLE messages",
        "CREATE TABLE messages (data, topic_id, timestamp, id INTEGER PRIMARY KEY)",
    ],
    "a computed column": [
        "DROP TABLE messages",
        "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id AS (1), timestamp, data)",
    ],
    "an endless view": [
        "DROP TABLE messages",
        "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
        "SELECT id, 1 AS topic_id, 0 AS timestamp, zeroblob(1000) AS data FROM n",
    ],
}


@pytest.mark.parametrize("case", SQL_OF_OTHER_TABLES)
def test_a_database_of_other_tables_is_no_bag(tmp_path: Path, case: str) -> None:
    path = write_db3(tmp_path / "bag", pairs(1))
    with closing(sqlite3.connect(path)) as bag:
        for statement in SQL_OF_OTHER_TABLES[case]:
            bag.execute(statement)
        bag.commit()
    with pytest.raises(DriverError, match="no bag of ROS 2"):
        LogReader(path)


@pytest.mark.parametrize("name", ["mcap", "db3"])
def test_other_topics_and_broken_messages_are_left_out(tmp_path: Path, name: str) -> None:
    noise = [Entry("/chatter", "std_msgs/msg/String", text("hello"), START_NS + n) for n in range(50)]
    junk = Entry(UPPER, COMPRESSED, b"\0\1\0\0junk", START_NS + 1)
    found, reader = read(FORMATS[name](tmp_path, [*noise, *pairs(4), junk]))
    assert found == expected(4) and reader.counts["broken"] == 1 and "no valid image" in reader.warnings[0]
