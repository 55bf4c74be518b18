"""Logs that are written: what others read of them, and recordings of limited size on disks that are full or fail."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from rosbags.highlevel import AnyReader

from drivers.logs.log_reader import LogReader, open_log
from drivers.logs.mcap_writer import LogWriter, RotatingLog, RotationSettings
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, START_NS, STORE, Entry, pairs, text

ROOT = Path(__file__).parents[3]
RIG = {"rig.toml": b"version = 1"}
ROOMY = RotationSettings(file_bytes=10**9, file_s=1e6, keep_bytes=10**10, free_bytes=0)
TICK_NS = 33_333_333


class Events(list[tuple[int, str]]):
    """Reported events, in order."""

    def __call__(self, level: int, text: str) -> None:
        self.append((level, text))


class Bench:
    """A recording of noise that no compression makes smaller, at 30 messages a second of stamps."""

    def __init__(self, folder: Path, rotation: RotationSettings, name: str = "robot") -> None:
        self.folder, self.events = folder, Events()
        self.log = RotatingLog(folder, name, rotation, RIG, on_event=self.events)
        self.state, self._count = self.log.state, 0

    def write(self, count: int, size: int = 1000) -> None:
        for _ in range(count):
            self.log.write(LOWER, COMPRESSED, os.urandom(size), START_NS + self._count * TICK_NS)
            self._count += 1

    def names(self) -> list[str]:
        return sorted(path.name for path in self.folder.iterdir())


def counted(path: Path) -> int:
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None and summary.statistics is not None
    return summary.statistics.message_count


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    """Create benches in the folder of the test."""
    benches: list[Bench] = []

    def make(rotation: RotationSettings = ROOMY, name: str = "robot", folder: Path = tmp_path / "log") -> Bench:
        benches.append(Bench(folder, rotation, name))
        return benches[-1]

    yield make
    for each in benches:
        each.log.close()


def test_a_closed_recording_takes_no_more_messages(bench: Callable[..., Bench]) -> None:
    recording = bench()
    recording.write(30)
    recording.log.close()
    recording.log.close()
    recording.write(1)
    (path,) = recording.folder.iterdir()
    assert path.name == "robot_20231114T221320Z_001.mcap" and counted(path) == 30
    assert (recording.state.status, recording.state.messages, recording.state.lost) == ("closed", 31, 1)


@pytest.mark.parametrize(
    "rotation", [replace(ROOMY, file_bytes=500_000), replace(ROOMY, file_s=50 * TICK_NS / 1e9)], ids=["size", "age"]
)
def test_a_new_file_begins_by_size_and_by_age(bench: Callable[..., Bench], rotation: RotationSettings) -> None:
    recording = bench(rotation)
    recording.write(200, size=10_000)
    recording.log.close()
    files = sorted(recording.folder.iterdir())
    counts = [counted(file) for file in files]
    assert len(files) == recording.state.files == 4 and sum(counts) == 200
    assert all(45 <= count <= 80 for count in counts[:-1])
    for file in files:  # each can be replayed alone
        with file.open("rb") as opened:
            assert [a.name for a in make_reader(opened).iter_attachments()] == ["rig.toml"]


def test_the_oldest_files_are_deleted_and_counted(bench: Callable[..., Bench]) -> None:
    recording = bench(replace(ROOMY, file_s=1.0, file_bytes=100_000, keep_bytes=180_000))
    strangers = ["notes.txt", "robot_20200101T000000Z_001.mcap.bak", "other_20200101T000000Z_001.mcap"]
    recording.folder.mkdir()
    for name in strangers:
        (recording.folder / name).write_bytes(b"mine")
    left_by_a_crash = recording.folder / "robot_20200101T000000Z_001.mcap"
    left_by_a_crash.write_bytes(b"cut")
    recording.write(300)
    recording.log.close()
    names = recording.names()
    assert set(strangers) < set(names) and left_by_a_crash.name not in names
    assert [name[-8:] for name in names if name not in strangers] == ["008.mcap", "009.mcap", "010.mcap"]
    assert recording.state.deleted == 8 and recording.state.lost == 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 3 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=3m", "none", str(disk)]
    made = subprocess.run(command, capture_output=True, check=False)
    if made.returncode:
        pytest.skip("only root can mount a small file system")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def fill(disk: Path) -> Path:
    """Create a file that uses all free space."""
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(4096)):
            pass
    return ballast


def try_again(recording: Bench) -> None:
    """Write single messages until the recording continues."""
    deadline_s = time.monotonic() + 20
    while recording.state.status == "stopped":
        assert time.monotonic() < deadline_s, recording.state
        recording.write(1)
        time.sleep(0.01)


def test_a_full_disk_stops_the_recording_until_there_is_room(small_disk: Path, bench: Callable[..., Bench]) -> None:
    recording = bench(replace(ROOMY, file_bytes=10**6), folder=small_disk / "log")
    recording.write(40, size=10_000)
    ballast = fill(small_disk)
    recording.write(300, size=10_000)
    assert recording.state.status == "stopped" and "No space left" in recording.events[0][1]
    assert [level for level, _ in recording.events] == [logging.WARNING] and recording.names() == [
        "robot_20231114T221320Z_001.mcap"
    ]  # what was saved until then, and no more than that
    lost = recording.state.lost
    time.sleep(1.1)
    recording.write(10)  # the next try fails too, and is not reported again
    assert recording.state.lost == lost + 10 and len(recording.events) == 1
    ballast.unlink()
    try_again(recording)
    recording.write(50, size=10_000)
    recording.log.close()
    assert [level for level, _ in recording.events] == [logging.WARNING, logging.INFO]
    assert recording.events[1][1].endswith(f"; lost: {recording.state.lost}")
    cut, *files = (recording.folder / name for name in recording.names())
    whole, saved = sum(map(counted, files)), len(list(open_log(cut).messages()))
    assert saved >= 25 and whole >= 50
    assert recording.state.messages == saved + whole + recording.state.lost


def test_the_reserved_space_stays_free_and_the_file_is_completed(small_disk: Path, bench: Callable[..., Bench]) -> None:
    rotation = replace(ROOMY, file_bytes=2 * 10**6, free_bytes=10**6, sync_s=0.0)
    recording = bench(rotation, folder=small_disk / "log")
    recording.write(20, size=10_000)
    (small_disk / "ballast").write_bytes(bytes(1_200_000))
    recording.write(300, size=10_000)
    disk = os.statvfs(small_disk)
    assert 700_000 < disk.f_bavail * disk.f_frsize <= 10**6
    assert recording.state.status == "stopped" and "make room" in recording.state.problem
    assert len(recording.events) == 1 and "MB are free" in recording.events[0][1]
    assert sum(map(counted, recording.folder.iterdir())) + recording.state.lost == 320


def test_a_file_that_was_deleted_is_followed_by_another(bench: Callable[..., Bench]) -> None:
    recording = bench(replace(ROOMY, sync_s=0.0))
    recording.write(3)
    for path in recording.folder.iterdir():
        path.unlink()
    recording.write(1)
    assert recording.state.status == "stopped" and "No such file" in recording.state.problem
    try_again(recording)
    assert len(recording.names()) == 1


@pytest.mark.parametrize("name", ["ü n/../..", "%s\0\n"])
def test_no_name_escapes_the_folder(bench: Callable[..., Bench], name: str) -> None:
    recording = bench(name=name)
    recording.write(3)
    recording.log.close()
    (file,) = recording.folder.iterdir()
    assert counted(file) == 3 and file.name.isprintable()


# One file

ATTACHED = {"rig.toml": b"version = 1", "omnid.toml": b""}


def written(path: Path, entries: list[Entry], **options: object) -> Path:
    with closing(LogWriter(path, ATTACHED, **options)) as log:  # type: ignore[arg-type]
        for entry in entries:
            log.write(entry.topic, entry.type, memoryview(entry.data), entry.log_time_ns)
    return path


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.NONE])
def test_rosbags_and_the_log_reader_read_the_log(tmp_path: Path, compression: CompressionType) -> None:
    entries = [*pairs(30), Entry("/chatter", "std_msgs/msg/String", text("hello"), START_NS)]
    path = written(tmp_path / "log.mcap", entries, compression=compression)
    with AnyReader([path]) as bag:
        found = [Entry(c.topic, c.msgtype, bytes(data), stamp) for c, stamp, data in bag.messages()]
        chatter = [
            STORE.deserialize_cdr(data, c.msgtype).data for c, _, data in bag.messages() if c.topic == "/chatter"
        ]
    assert sorted(found) == sorted(entries) and chatter == ["hello"]
    reader = LogReader(path)
    assert len(list(reader.frames())) == 60 and not reader.warnings
    assert reader.attachments() == ATTACHED and reader.pair_estimate() == 30


DIES = """
import os, sys
from drivers.logs.mcap_writer import LogWriter
from tests.drivers.logs.mcap_logs import pairs
log = LogWriter(sys.argv[1], {"rig.toml": b"version = 1"})
for entry in pairs(50):
    log.write(entry.topic, entry.type, entry.data, entry.log_time_ns)
os._exit(9)
"""


def test_a_crash_loses_at_most_half_a_second(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    command = [sys.executable, "-c", DIES, str(path)]
    assert subprocess.run(command, cwd=Path(__file__).parents[3], check=False).returncode == 9
    reader = LogReader(path)
    count = len(list(reader.frames()))
    assert 90 <= count < 100
    assert "is cut" in reader.warnings[0] and reader.attachments() == {"rig.toml": b"version = 1"}
