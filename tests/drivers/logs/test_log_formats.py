"""Logs of several files and formats: parts of one recording are read as one, and each format has its contents."""

from __future__ import annotations

import fcntl
import random
from contextlib import closing
from pathlib import Path

import pytest

from drivers.errors import DriverError
from drivers.logs.log_formats import log_info, logs_in
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_info import LogState
from tests.drivers.logs.bags import write_bag, write_db3
from tests.drivers.logs.foreign_logs import PAIRS, expected, read, write_folders
from tests.drivers.logs.mcap_logs import COMPRESSED, START_NS, pairs, write_log


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
