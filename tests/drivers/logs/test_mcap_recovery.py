"""Recovery of truncated, corrupt and malicious logs."""

from __future__ import annotations

import os
import random
import resource
import shutil
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_records import MAGIC
from drivers.logs.mcap_recovery import Recovery, recover
from drivers.logs.mcap_writer import LogWriter
from tests.drivers.logs.mcap_logs import BARE, START_NS, Entry, pairs, text, write_log
from tests.drivers.logs.test_mcap_records import HOSTILE, LAYOUTS

RIG = [("rig.toml", b"version = 1"), ("big", bytes(3 * 2**20))]


def messages(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    """Return the messages that the mcap package reads, with CRCs checked, in the order of the file."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = reader.iter_messages(log_time_order=False)
        return [(c.topic, m.log_time, m.publish_time, m.sequence, m.data) for _, c, m in found]


def recovered(path: Path, out: Path) -> Recovery | None:
    """Recover a log; None where nothing can be recovered: no file is left, and the message has one line."""
    out.unlink(missing_ok=True)
    try:
        found = recover(path, out)
    except DriverError as error:
        assert str(error).isprintable() and not out.exists()
        return None
    again = out.with_name("again.mcap")
    again.unlink(missing_ok=True)
    assert replace(recover(out, again), end=0) == Recovery(found.messages, found.attachments, 0, 0, 0, True)
    return found


@pytest.mark.parametrize("layout", [*LAYOUTS, BARE | {"use_chunking": False}])
def test_recovers_truncated_logs(tmp_path: Path, layout: dict[str, Any]) -> None:
    path, out = write_log(tmp_path / "log.mcap", pairs(3), RIG[:1], **layout), tmp_path / "out.mcap"
    whole, size = messages(path), path.stat().st_size
    saved = []
    for cut in range(size, 0, -71):
        os.truncate(path, cut)
        found = recovered(path, out)
        if found is None:
            saved.append(0)
            continue
        assert found.whole == (cut == size and layout.get("use_statistics", True))
        assert messages(out) == whole[: found.messages]
        with out.open("rb") as file:
            assert [(a.name, a.data) for a in make_reader(file).iter_attachments()] == RIG[: found.attachments]
        saved.append(found.messages)
    assert saved == sorted(saved, reverse=True) and saved[0] == 6 and 0 in saved


def test_other_readers_accept_the_result(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(30), RIG, compression=CompressionType.ZSTD)
    entries = sorted(pairs(30))
    os.truncate(path, path.stat().st_size - 3000)
    out = tmp_path / "out.mcap"
    found = recover(path, out)
    with AnyReader([out]) as bag:
        read = [Entry(c.topic, c.msgtype, bytes(data), stamp) for c, stamp, data in bag.messages()]
    assert 40 <= len(read) == found.messages and set(read) <= set(entries) and found.attachments == 2
    reader = LogReader(out)
    assert len(list(reader.frames())) == found.messages and not reader.warnings
    with out.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None and {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        assert make_reader(file).get_header().profile == "ros2"


@pytest.mark.parametrize("layout", LAYOUTS)
def test_detects_flipped_bits(tmp_path: Path, layout: dict[str, Any]) -> None:
    path, out = write_log(tmp_path / "log.mcap", pairs(3), RIG[:1], **layout), tmp_path / "out.mcap"
    whole, expected, chance = path.read_bytes(), set(messages(path)), random.Random(11)
    saved = 0
    for _ in range(40):
        data = bytearray(whole)
        for _ in range(chance.choice((1, 1, 5))):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        path.write_bytes(data[: chance.choice((len(data), chance.randrange(len(data))))])
        found = recovered(path, out)
        if found is not None and layout.get("use_chunking", True):
            assert {entry[1:] for entry in messages(out)} <= {entry[1:] for entry in expected}  # names have no CRC
        saved += found.messages if found is not None else 0
    assert saved > 40


@pytest.mark.parametrize("damage", range(20))
def test_refuses_noise_in_one_line(tmp_path: Path, damage: int) -> None:
    chance = random.Random(damage)
    (tmp_path / "log.mcap").write_bytes(MAGIC * (damage % 2) + chance.randbytes(chance.randrange(2000)))
    assert recovered(tmp_path / "log.mcap", tmp_path / "out.mcap") is None


@pytest.mark.parametrize("name", HOSTILE)
def test_wrong_lengths_need_no_memory(tmp_path: Path, name: str) -> None:
    path, out = write_log(tmp_path / "log.mcap", pairs(2)), tmp_path / "out.mcap"
    whole = path.read_bytes()
    at = whole.index(b"\x06", len(MAGIC) + 20)
    path.write_bytes(whole[:at] + HOSTILE[name]() + whole[at:])
    tracemalloc.start()
    try:
        recovered(path, out)
        assert tracemalloc.get_traced_memory()[1] < 16 * 2**20
    finally:
        tracemalloc.stop()


def chunk_places(path: Path) -> list[int]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [chunk.chunk_start_offset for chunk in summary.chunk_indexes]


@pytest.mark.parametrize("where", [0, 7], ids=["the first chunk, which defines the channels", "another"])
@pytest.mark.parametrize("offset", [2, 6, 60], ids=["its length", "its length, beyond the file", "its content"])
def test_a_corrupt_chunk_loses_only_itself_where_there_is_an_index(tmp_path: Path, where: int, offset: int) -> None:
    path, out = write_log(tmp_path / "log.mcap", pairs(30), RIG[:1], chunk_size=700), tmp_path / "out.mcap"
    expected, places = messages(path), chunk_places(path)
    data = bytearray(path.read_bytes())
    data[places[where] + offset] ^= 0x11
    path.write_bytes(data)
    found = recover(path, out)
    assert 56 <= found.messages < 60 and found.lost == 60 - found.messages and not found.whole
    assert 1 <= found.broken <= 2 and set(messages(out)) < set(expected)


def test_keeps_records_of_other_writers(tmp_path: Path) -> None:
    path, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    with path.open("wb") as file:
        writer = Writer(file, 200, CompressionType.LZ4)
        writer.start("other", "somebody")
        writer.add_metadata("rosbag2", {"storage": "mcap"})
        for n in range(5):  # without a schema, as JSON may be
            channel = writer.register_channel(f"/json/{n}", "json", 0, {"n": str(n)})
            writer.add_message(channel, n, b'{"a": 1}', n + 100, n + 7)
        writer.add_attachment(3, 4, "late", "text/x", b"")
        writer.finish()
    os.truncate(path, path.stat().st_size - 1)
    expected = [(f"/json/{n}", n, n + 100, n + 7, b'{"a": 1}') for n in range(5)]
    assert replace(recover(path, out), end=0) == Recovery(5, 1, None, 0, 0, False)
    assert messages(out) == expected
    with out.open("rb") as file:
        reader = make_reader(file)
        assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("rosbag2", {"storage": "mcap"})]
        (late,) = reader.iter_attachments()
        assert (late.create_time, late.log_time, late.media_type) == (3, 4, "text/x")
        summary = reader.get_summary()
        assert summary is not None and [c.metadata for c in summary.channels.values()] == [
            {"n": str(n)} for n in range(5)
        ]


def test_overwrites_nothing_and_leaves_no_partial_file(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(3))
    os.truncate(path, path.stat().st_size - 1)
    kept = tmp_path / "kept.mcap"
    kept.write_bytes(b"mine")
    for out, reason in ((kept, "it exists"), (path, "it exists"), (tmp_path / "no" / "out.mcap", "No such file")):
        with pytest.raises(DriverError, match=reason):
            recover(path, out)
    assert kept.read_bytes() == b"mine" and sorted(os.listdir(tmp_path)) == ["kept.mcap", "log.mcap"]


def test_skips_a_corrupt_attachment(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2), RIG[:1])
    path.write_bytes(path.read_bytes().replace(b"version = 1", b"version = 7"))
    found = recover(path, tmp_path / "out.mcap")
    assert (found.messages, found.attachments, found.broken, found.whole) == (4, 0, 1, False)


@pytest.fixture
def file_limit() -> Iterator[Callable[[int], None]]:
    """Return a function after which the kernel refuses files over so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("part", [0.5, 0.9999])
def test_a_full_disk_leaves_no_file(tmp_path: Path, file_limit: Callable[[int], None], part: float) -> None:
    path, out = write_log(tmp_path / "log.mcap", pairs(300)), tmp_path / "out.mcap"
    os.truncate(path, path.stat().st_size - 1)
    recover(path, out)
    size = out.stat().st_size
    out.unlink()
    file_limit(int(part * size))
    with pytest.raises(DriverError, match=r"cannot write '.*out\.mcap': File too large"):
        recover(path, out)
    assert not out.exists()


def test_refuses_a_log_that_is_being_written(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap") as log:
        log.write("/a", "std_msgs/msg/String", text("a"), START_NS)
        with pytest.raises(DriverError, match="being written"):
            recover(tmp_path / "log.mcap", tmp_path / "out.mcap")
    shutil.copy(tmp_path / "log.mcap", tmp_path / "copy.mcap")
    assert recover(tmp_path / "log.mcap", tmp_path / "out.mcap").whole


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    entries = (e._replace(data=e.data + os.urandom(200_000)) for e in pairs(100))
    path, out = write_log(tmp_path / "log.mcap", entries, chunk_size=2**20), tmp_path / "out.mcap"
    os.truncate(path, path.stat().st_size - 1)
    tracemalloc.start()
    try:
        assert recover(path, out).messages == 200
        assert tracemalloc.get_traced_memory()[1] < 12 * 2**20 < path.stat().st_size
    finally:
        tracemalloc.stop()
