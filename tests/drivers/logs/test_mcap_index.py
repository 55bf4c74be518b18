"""The summary of an MCAP file: attachments within their limits, and nothing of one that is corrupt."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.logs import mcap_index
from drivers.logs.log_reader import LogReader
from tests.drivers.logs.mcap_logs import (
    LOWER,
    UPPER,
    pairs,
    write_log,
)


def test_attachments_with_and_without_a_summary(tmp_path: Path) -> None:
    files = [("rig.toml", b"version = 1"), ("big", bytes(17 * 2**20)), ("empty", b"")]
    path = write_log(tmp_path / "log.mcap", pairs(2), files)
    assert LogReader(path).attachments() == {"rig.toml": b"version = 1", "empty": b""}
    path.write_bytes(path.read_bytes()[:-9])
    assert LogReader(path).attachments() == {"rig.toml": b"version = 1", "empty": b""}


@pytest.mark.parametrize("with_summary", [True, False])
def test_bounds_the_memory_of_all_attachments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_summary: bool
) -> None:
    monkeypatch.setattr(mcap_index, "MAX_ALL_ATTACHMENTS_BYTES", 5000)
    files = [(str(number), bytes(2000)) for number in range(4)] + [("rig.toml", b"version = 1")]
    path = write_log(tmp_path / "log.mcap", pairs(2), files)
    if not with_summary:
        path.write_bytes(path.read_bytes()[:-9])
    assert LogReader(path).attachments().keys() == {"0", "1", "rig.toml"}


def test_ignores_a_corrupt_attachment(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2), [("rig.toml", b"version = 1"), ("other", b"2")])
    path.write_bytes(path.read_bytes().replace(b"version = 1", b"version = 7"))
    assert LogReader(path).attachments() == {"other": b"2"}


def test_ignores_a_corrupt_summary(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(3))
    data = bytearray(path.read_bytes())
    data[data.rindex(LOWER.encode()) + 1] ^= 1
    path.write_bytes(data)
    reader = LogReader(path)
    assert reader.topics == {"lower": LOWER, "upper": UPPER} and reader.pair_estimate() is None
