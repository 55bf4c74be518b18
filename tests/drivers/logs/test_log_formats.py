"""Logs that are no MCAP file: bags of ROS 2 and ROS 1, written by rosbags, in parts, damaged; and folders of images."""

from __future__ import annotations

import fcntl
import os
import random
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer

from drivers.errors import DriverError
from drivers.frame import Frame, gray
from drivers.logs.log_formats import log_info, logs_in
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_info import LogState
from drivers.logs.sqlite_bag import SqliteBag
from drivers.logs.topic_choice import MotionTopics
from drivers.motion import GyroSample
from tests.drivers.logs.bags import ROS1, ros1_bytes, write_bag, write_db3
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, START_NS, STORE, Entry, jpeg, pairs, write_log
from tests.drivers.logs.repeated_pages import repeat_pages

PAIRS = 12


def contents(frames: list[Frame]) -> list[tuple[str, int, int, bytes]]:
    return [(frame.camera, frame.seq, frame.stamp_ns, bytes(frame.data)) for frame in frames]


def read(path: Path, **options: Any) -> tuple[list[tuple[str, int, int, bytes]], LogReader]:
    with closing(LogReader(path, **options)) as reader:
        return contents(list(reader.frames())), reader


def expected(tmp_path: Path, entries: list[Entry] | None = None) -> list[tuple[str, int, int, bytes]]:
    return read(write_log(tmp_path / "expected.mcap", entries or pairs(PAIRS)))[0]


def write_folders(top: Path, entries: list[Entry], names: Callable[[int], str] = str) -> Path:
    for entry in entries:
        folder = top / ("lower" if entry.topic == LOWER else "upper")
        folder.mkdir(parents=True, exist_ok=True)
        message = STORE.deserialize_cdr(entry.data, entry.type)
        (folder / f"{names(entry.log_time_ns)}.jpg").write_bytes(message.data.tobytes())
    return top


@pytest.mark.parametrize("zstd", [False, True])
def test_an_sqlite_bag_has_the_frames_of_the_same_mcap(tmp_path: Path, zstd: bool) -> None:
    path = write_db3(tmp_path / "bag", pairs(PAIRS), zstd)
    found, reader = read(path)
    assert found == expected(tmp_path) and not reader.warnings and not reader.truncated
    assert reader.pair_estimate is not None
    assert read(tmp_path / "bag")[0] == found
    with closing(LogReader(path)) as again:
        assert again.pair_estimate() == PAIRS and again.attachments() == {}


@pytest.mark.parametrize("compression", ["", "BZ2", "LZ4"])
def test_a_ros1_bag_has_the_frames_of_the_same_mcap(tmp_path: Path, compression: str) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(PAIRS), compression)
    found, reader = read(path)
    assert found == expected(tmp_path) and not reader.warnings
    with closing(LogReader(path)) as again:
        assert again.pair_estimate() == PAIRS


def test_raw_images_of_ros1(tmp_path: Path) -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    types = ROS1.types
    stamp = types["builtin_interfaces/msg/Time"](sec=START_NS // 10**9, nanosec=5)
    message = types["sensor_msgs/msg/Image"](
        types["std_msgs/msg/Header"](seq=7, stamp=stamp, frame_id="abc"), 3, 4, "mono8", 0, 4, pixels.ravel()
    )
    data = bytes(ROS1.serialize_ros1(message, "sensor_msgs/msg/Image"))
    with Ros1Writer(tmp_path / "log.bag") as writer:
        for topic in ("/lower/image_raw", "/upper/image_raw"):
            writer.write(writer.add_connection(topic, "sensor_msgs/msg/Image", typestore=ROS1), START_NS, data)
    with closing(LogReader(tmp_path / "log.bag")) as reader:
        frames = list(reader.frames())
    assert [frame.stamp_ns for frame in frames] == [START_NS + 5] * 2
    assert all((gray(frame) == pixels).all() for frame in frames)


def test_an_mcap_that_was_converted_from_ros1(tmp_path: Path) -> None:
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros1", "test")
        schema = writer.register_schema("sensor_msgs/CompressedImage", "ros1msg", b"")
        imu = writer.register_channel("/imu", "ros1", writer.register_schema("sensor_msgs/Imu", "ros1msg", b""))
        channels: dict[str, int] = {}
        for entry in pairs(PAIRS):
            if entry.topic not in channels:
                channels[entry.topic] = writer.register_channel(entry.topic, "ros1", schema)
            writer.add_message(channels[entry.topic], entry.log_time_ns, ros1_bytes(entry), entry.log_time_ns)
        rates = struct.pack("<IIII37d", 1, 100, 0, 0, *[0.0] * 13, 0.1, 0.2, 0.3, *[0.0] * 21)
        writer.add_message(imu, START_NS, rates, START_NS)
        writer.finish()  # type: ignore[no-untyped-call]
    assert read(tmp_path / "log.mcap")[0] == expected(tmp_path)
    with closing(LogReader(tmp_path / "log.mcap", motion=MotionTopics(imu="/imu"))) as reader:
        samples = [message for message in reader.messages() if not isinstance(message, Frame)]
    assert samples == [GyroSample(100 * 10**9, 0.1, 0.2, 0.3)]


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
    assert found == expected(tmp_path, entries) and not reader.warnings
    (folder / f"bag_5.{suffix}").unlink()
    with pytest.raises(DriverError, match=f"bag_0.{suffix}, bag_1.{suffix}.* give one file"):
        LogReader(folder)


def test_omnids_own_recordings_of_one_run_are_parts(tmp_path: Path) -> None:
    entries, folder = pairs(4), tmp_path / "recordings"
    folder.mkdir()
    write_log(folder / "omnid_20261122T050000Z_001.mcap", entries[:4], [("rig.toml", b"one")])
    write_log(folder / "omnid_20261122T051000Z_002.mcap", entries[4:], [("rig.toml", b"two")])
    assert read(folder)[0] == expected(tmp_path, entries)
    with closing(LogReader(folder)) as reader:
        assert reader.attachments() == {"rig.toml": b"one"}


def test_a_cut_part_is_reported(tmp_path: Path) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    for part in range(2):
        write_log(folder / f"bag_{part}.mcap", pairs(PAIRS))
    path = folder / "bag_1.mcap"
    path.write_bytes(path.read_bytes()[:-2000])
    _, reader = read(folder)
    assert reader.truncated and "bag_1.mcap" in reader.warnings[0]


def test_a_recording_that_was_not_completed_is_the_last_part(tmp_path: Path) -> None:
    folder, entries = tmp_path / "recordings", pairs(4)
    folder.mkdir()
    write_log(folder / "omnid_20261122T050000Z_001.mcap", entries[:4])
    cut = write_log(folder / "omnid_20261122T051000Z_002.mcap.part", entries[4:])
    cut.write_bytes(cut.read_bytes()[:-500])
    found, reader = read(folder)
    assert len(found) > 4 and reader.truncated and "_002.mcap.part" in reader.warnings[0]
    assert log_info(folder).state is LogState.BROKEN
    (folder / "omnid_20261122T050000Z_001.mcap").unlink()
    assert read(folder)[1].truncated


def test_a_recording_that_was_recovered_or_is_written_is_not_read_twice_or_at_all(tmp_path: Path) -> None:
    entries = pairs(4)
    write_log(tmp_path / "omnid_20261122T050000Z_001.mcap", entries[:4])
    cut = write_log(tmp_path / "omnid_20261122T051000Z_002.mcap.part", entries[4:])
    with cut.open("rb") as writer:
        fcntl.flock(writer.fileno(), fcntl.LOCK_EX)
        assert [log.name for log in logs_in(tmp_path)] == ["omnid_20261122T050000Z_001.mcap"]
    write_log(cut.with_suffix(""), entries[4:])
    assert len(logs_in(tmp_path)) == 2 and not read(tmp_path)[1].truncated


def test_recordings_of_two_runs_are_not_one_log(tmp_path: Path) -> None:
    """Of the first run the oldest files are gone, by the limit of their number."""
    write_log(tmp_path / "omnid_20260202T023000Z_002.mcap", pairs(2))
    write_log(tmp_path / "omnid_20260203T023000Z_001.mcap", pairs(2))
    with pytest.raises(DriverError, match="give one file"):
        LogReader(tmp_path)


@pytest.mark.parametrize("names", [str, lambda stamp: f"{stamp // 10**9}.{stamp % 10**9:09d}"])
def test_folders_of_images_with_stamps(tmp_path: Path, names: Callable[[int], str]) -> None:
    folder = write_folders(tmp_path / "images", pairs(PAIRS), names)
    (folder / "rig.toml").write_text("[rig]")
    found, reader = read(folder)
    assert found == expected(tmp_path) and not reader.warnings
    with closing(LogReader(folder)) as again:
        assert again.attachments() == {"rig.toml": b"[rig]"} and again.pair_estimate() == PAIRS


def test_folders_with_a_list_of_stamps(tmp_path: Path) -> None:
    numbers = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp: f"{numbers[stamp]:010d}")
    for camera in ("lower", "upper"):
        stamps = [frame[2] for frame in expected(tmp_path) if frame[0] == camera]
        lines = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in stamps]
        (folder / camera / "timestamps.txt").write_text("\n".join(lines) + "\n")
    assert read(folder)[0] == expected(tmp_path)
    for path in folder.glob("*/*.jpg"):  # 10 comes after 9, not after 1
        path.rename(path.with_stem(str(int(path.stem))))
    assert read(folder)[0] == expected(tmp_path)
    kept = (folder / "upper" / "timestamps.txt").read_text()
    for name in ("0000000007", "7"):  # without the list it would be taken for 7 s
        (folder / "upper" / "timestamps.txt").unlink(missing_ok=True)
        with pytest.raises(DriverError, match=r"upper' are numbered, .*timestamps.txt"):
            LogReader(folder)
        for path in (folder / "upper").glob("*.jpg"):
            path.rename(path.with_stem(f"{int(path.stem):0{len(name)}d}"))
    (folder / "upper" / "timestamps.txt").write_text(kept)
    assert read(folder)[0] == expected(tmp_path)
    (folder / "upper" / "timestamps.txt").write_text("1.0\n")
    with pytest.raises(DriverError, match="12 images, and its list of stamps 1 lines"):
        LogReader(folder)


def test_cameras_of_folders_with_other_names_are_given(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / "images", pairs(PAIRS))
    for camera, name in (("lower", "cam0"), ("upper", "cam1")):
        (folder / "mav0" / name).mkdir(parents=True)
        (folder / camera).rename(folder / "mav0" / name / "data")
    with pytest.raises(DriverError, match="mav0/cam0/data, mav0/cam1/data; give --lower and --upper"):
        LogReader(folder)
    assert read(folder, lower="mav0/cam0/data", upper="mav0/cam1/data")[0] == expected(tmp_path)


@pytest.mark.parametrize(
    ("step", "apart"),
    [(100_000_000, "3.2 years"), (10_000, "2.8 hours"), (100_000, "27.8 hours"), (1_000_000, "12 days")],
)
def test_images_hours_apart_are_a_question(tmp_path: Path, step: int, apart: str) -> None:
    """Names of 10 digits that count nanoseconds or so would be seconds; one line says so, names the images and asks."""
    numbers = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp: f"{step * numbers[stamp]:010d}")
    with pytest.raises(DriverError, match=f"0000000000.* are {apart} apart .*fewer than 16 digits are seconds"):
        LogReader(folder)


def test_images_named_by_microseconds_are_not_taken_for_nanoseconds(tmp_path: Path) -> None:
    numbers = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}
    folder = write_folders(
        tmp_path / "images", pairs(PAIRS), lambda stamp: str(1_418_381_798_086_398 + 33_333 * numbers[stamp])
    )
    with pytest.raises(DriverError, match=r"1418381798086398.* are 33\.333 us apart .*microseconds"):
        LogReader(folder)


def test_images_less_than_an_hour_apart_are_a_log(tmp_path: Path) -> None:
    numbers = {entry.log_time_ns: index // 2 for index, entry in enumerate(pairs(PAIRS))}
    folder = write_folders(tmp_path / "images", pairs(PAIRS), lambda stamp: f"{3600 * numbers[stamp]:010d}")
    assert len(read(folder)[0]) == 2 * PAIRS


def test_an_image_without_stamp_is_refused(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / "images", pairs(1), lambda stamp: f"frame{stamp % 100}")
    with pytest.raises(DriverError, match=r"is named 'frame0'; expected a stamp.* timestamps\.txt"):
        LogReader(folder)


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag", "folder"])
def test_tells_the_contents_of_each_format(tmp_path: Path, kind: str) -> None:
    entries = pairs(PAIRS)
    path = {
        "mcap": lambda: write_log(tmp_path / "log.mcap", entries),
        "db3": lambda: write_db3(tmp_path / "bag", entries),
        "bag": lambda: write_bag(tmp_path / "log.bag", entries),
        "folder": lambda: write_folders(tmp_path / "images", entries),
    }[kind]()
    found = log_info(path)
    assert [(kind, count) for kind, count in found.topics.values()] == [(COMPRESSED, PAIRS)] * 2
    assert found.span_ns == (START_NS, START_NS + (PAIRS - 1) * 10**8 + 10**6) and found.state is LogState.WHOLE
    assert found.size_bytes > 1000 and found.messages == 2 * PAIRS


def test_tells_that_a_bag_is_cut(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(PAIRS))
    path.write_bytes(path.read_bytes()[:-3000])
    assert log_info(path).state is LogState.BROKEN


def test_an_sqlite_file_that_is_no_bag(tmp_path: Path) -> None:
    path = tmp_path / "notes.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE notes (text)")
        database.commit()
    with pytest.raises(DriverError, match="no bag of ROS 2"):
        LogReader(path)


def test_a_view_in_place_of_the_messages_is_refused(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "bag", pairs(1))
    with closing(sqlite3.connect(path)) as bag:
        bag.execute("DROP TABLE messages")
        bag.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, 1 AS topic_id, 0 AS timestamp, zeroblob(1000) AS data FROM n"
        )
        bag.commit()
    with pytest.raises(DriverError, match="no bag of ROS 2"):
        LogReader(path)


def test_a_bag_that_was_not_closed(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(PAIRS))
    whole = path.read_bytes()
    index = int.from_bytes(whole[whole.index(b"index_pos=") + 10 :][:8], "little")
    path.write_bytes(whole[:index].replace(b"index_pos=" + index.to_bytes(8, "little"), b"index_pos=" + bytes(8)))
    found, reader = read(path)
    assert found == expected(tmp_path) and reader.truncated and "was not closed" in reader.warnings[0]


def test_a_bomb_is_skipped(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", pairs(1), "BZ2")
    data = path.read_bytes()
    at = data.index(b"size=") + 5
    path.write_bytes(data[:at] + (2**32 - 1).to_bytes(4, "little") + data[at + 4 :])
    found, reader = read(path)
    assert found == [] and reader.counts["broken_records"] == 1


def mutated(data: bytes, chance: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(chance.randint(1, 12)):
        at = chance.randrange(len(changed))
        changed[at : at + 1] = chance.choice([bytes([chance.randrange(256)]), b"", b"\xff" * 4, bytes(8)])
        changed = changed or bytearray(b"x")
    return bytes(changed[: chance.randint(1, len(changed))]) if chance.random() < 0.2 else bytes(changed)


@pytest.mark.parametrize("kind", ["db3", "bag"])
def test_damaged_bags_give_frames_or_one_line(tmp_path: Path, kind: str) -> None:
    whole = write_db3(tmp_path / "bag", pairs(4)) if kind == "db3" else write_bag(tmp_path / "log.bag", pairs(4), "LZ4")
    data, chance, path = whole.read_bytes(), random.Random(5), tmp_path / f"damaged.{kind}"
    valid = {frame[2] for frame in read(whole)[0]}
    refused = complete = 0
    for _ in range(150):
        path.write_bytes(mutated(data, chance))
        try:
            found, _ = read(path)
            complete += len(found) == len(valid)
        except DriverError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused and complete


def test_a_message_of_another_type_is_left_out(tmp_path: Path) -> None:
    entries = [Entry(LOWER, COMPRESSED, b"\0\1\0\0junk", START_NS), *pairs(2)]
    found, reader = read(write_db3(tmp_path / "bag", entries))
    assert len(found) == 4 and reader.counts["broken"] == 1 and jpeg(1)


def test_a_bag_whose_pages_are_named_again_and_again_ends(tmp_path: Path) -> None:
    """500**6 times the rows of one leaf: neither those that are wanted nor those of other topics are read for ever."""
    path = write_db3(tmp_path / "bag", [Entry(LOWER, COMPRESSED, b"\0\1\0\0", START_NS)] * 8)
    repeat_pages(path)
    assert path.stat().st_size < 100_000
    with closing(SqliteBag(path)) as bag:
        assert bag.counts() is None
        assert len(list(bag.messages())) <= path.stat().st_size // 8
        assert "more rows than its size allows" in bag.damage().cut
        bag._topics = {99: (LOWER, COMPRESSED)}
        assert list(bag.messages()) == [] and "interrupted" in bag.damage().cut
    assert log_info(path).state is LogState.BROKEN


@pytest.mark.parametrize(
    "columns",
    ["data, topic_id, timestamp, id INTEGER PRIMARY KEY", "id INTEGER PRIMARY KEY, topic_id AS (1), timestamp, data"],
)
def test_a_table_of_other_columns_is_no_bag(tmp_path: Path, columns: str) -> None:
    path = write_db3(tmp_path / "bag", pairs(1))
    with closing(sqlite3.connect(path)) as bag:
        bag.execute("DROP TABLE messages")
        bag.execute(f"CREATE TABLE messages ({columns})")
        bag.commit()
    with pytest.raises(DriverError, match="no bag of ROS 2"):
        LogReader(path)


@pytest.mark.parametrize("kind", ["pipe", "device", "link", "folder"])
@pytest.mark.parametrize("name", ["lower/1700000000000000001.jpg", "rig.toml"])
def test_folders_hold_regular_files_only(tmp_path: Path, kind: str, name: str) -> None:
    """Anything else is one line, and nothing waits for a pipe; a rig that is none is left out."""
    folder, odd = write_folders(tmp_path / "images", pairs(2)), tmp_path / "images" / name
    (tmp_path / "secret").write_text("secret")
    if kind == "pipe":
        os.mkfifo(odd)
    elif kind == "folder":
        odd.mkdir()
    else:
        odd.symlink_to("/dev/zero" if kind == "device" else tmp_path / "secret")
    if name == "rig.toml":
        with closing(LogReader(folder)) as reader:
            assert reader.attachments() == {}
        return
    with pytest.raises(DriverError, match=r"1700000000000000001.jpg': no regular file of the folder") as refused:
        LogReader(folder)
    assert "\n" not in str(refused.value)


def test_a_link_within_the_folder_is_an_image_and_a_pipe_that_comes_later_is_not_waited_for(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / "images", pairs(3))
    first, last = (sorted((folder / "lower").iterdir())[number] for number in (0, -1))
    (folder / "kept").mkdir()
    first.rename(folder / "kept" / "image")
    first.symlink_to(folder / "kept" / "image")
    with closing(LogReader(folder)) as reader:
        last.unlink()
        os.mkfifo(last)
        assert len(list(reader.frames())) == 5 and reader.counts["broken"] + reader.counts["broken_records"] == 1
