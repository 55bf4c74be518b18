from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
from rosbags.highlevel import AnyReader

from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_writer import LogWriter
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, START_NS, STORE, Entry, pairs, text

RIG = {"rig.toml": b"version = 1", "omnid.toml": b""}


def written(path: Path, entries: list[Entry], **options: object) -> Path:
    with LogWriter(path, RIG, **options) as log:  # type: ignore[arg-type]
        for entry in entries:
            log.write(entry.topic, entry.type, memoryview(entry.data), entry.log_time_ns)
    return path


@pytest.mark.parametrize("compression", ["lz4", "none"])
@pytest.mark.parametrize("chunk_bytes", [1, 256 * 1024])
def test_rosbags_and_the_log_reader_read_it(
    tmp_path: Path, compression: Literal["lz4", "none"], chunk_bytes: int
) -> None:
    entries = [*pairs(30), Entry("/chatter", "std_msgs/msg/String", text("hello"), START_NS)]
    path = written(tmp_path / "log.mcap", entries, chunk_bytes=chunk_bytes, compression=compression)
    with AnyReader([path]) as bag:
        found = [Entry(c.topic, c.msgtype, bytes(data), stamp) for c, stamp, data in bag.messages()]
        chatter = [
            STORE.deserialize_cdr(data, c.msgtype).data for c, _, data in bag.messages() if c.topic == "/chatter"
        ]
    assert sorted(found) == sorted(entries) and chatter == ["hello"]
    reader = LogReader(path)
    assert len(list(reader.frames())) == 60 and not reader.truncated and not reader.warnings
    assert reader.attachments() == RIG and reader.pair_estimate() == 30


DIES = """
import os, sys
from drivers.logs.mcap_writer import LogWriter
from tests.drivers.logs.mcap_logs import pairs
log = LogWriter(sys.argv[1], {"rig.toml": b"version = 1"}, int(sys.argv[2]))
for entry in pairs(50):
    log.write(entry.topic, entry.type, entry.data, entry.log_time_ns)
os._exit(9)
"""


@pytest.mark.parametrize("chunk_bytes", [2000, 2**30])
def test_a_crash_loses_at_most_the_last_chunk_or_second(tmp_path: Path, chunk_bytes: int) -> None:
    path = tmp_path / "log.mcap"
    command = [sys.executable, "-c", DIES, str(path), str(chunk_bytes)]
    assert subprocess.run(command, cwd=Path(__file__).parents[3], check=False).returncode == 9
    reader = LogReader(path)
    count = len(list(reader.frames()))
    assert (95 if chunk_bytes == 2000 else 80) <= count < 100
    assert reader.truncated and reader.attachments() == {"rig.toml": b"version = 1"}


def test_a_full_disk_is_an_error_at_once() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("there is no /dev/full here")
    reason = os.strerror(errno.ENOSPC)
    with pytest.raises(DriverError, match=reason):
        LogWriter(full, RIG)


@pytest.fixture
def small_files() -> Iterator[None]:
    """The kernel refuses files over 100 kB, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("chunk_bytes", [2000, 2**30])
def test_a_log_on_a_full_disk_stays_readable(tmp_path: Path, small_files: None, chunk_bytes: int) -> None:
    log = LogWriter(tmp_path / "log.mcap", RIG, chunk_bytes, compression="none")
    entries = pairs(200)
    with pytest.raises(DriverError, match=os.strerror(errno.EFBIG)):
        for entry in entries:
            log.write(*entry)
        log.close()
    with pytest.raises(DriverError, match="closed or failed"):
        log.write(*entries[0])
    log.close()
    reader = LogReader(tmp_path / "log.mcap")
    assert reader.attachments() == RIG and len(list(reader.frames())) > 100


def test_invalid_messages_are_errors_and_do_not_damage_the_log(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        with pytest.raises(DriverError, match="unknown message type 'no/msg/Such'"):
            log.write("/a", "no/msg/Such", b"", START_NS)
        with pytest.raises(DriverError, match="-1 ns is not a time"):
            log.write(LOWER, COMPRESSED, b"", -1)
        for entry in pairs(2):
            log.write(*entry)
    log.close()
    with pytest.raises(DriverError, match="closed"):
        log.write(*pairs(1)[0])
    assert len(list(LogReader(path).frames())) == 4
