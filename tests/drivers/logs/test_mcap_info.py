"""Contents of an MCAP log: whole, being written, without an index, cut."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.writer import IndexType

from drivers.errors import DriverError
from drivers.logs.file_lock import lock
from drivers.logs.mcap_info import LogState, read_log_info
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, START_NS, UPPER, pairs, write_log

SPAN_NS = (START_NS, START_NS + 9 * 10**8 + 10**6)


@pytest.mark.parametrize("with_index", [True, False])
def test_contents_are_the_same_with_and_without_an_index(tmp_path: Path, with_index: bool) -> None:
    options = {} if with_index else {"index_types": IndexType.NONE, "use_statistics": False}
    path = write_log(tmp_path / "log.mcap", pairs(10), [("rig.toml", b"version = 1")], **options)
    found = read_log_info(path)
    assert found.topics == {LOWER: (COMPRESSED, 10), UPPER: (COMPRESSED, 10)} and found.messages == 20
    assert found.span_ns == SPAN_NS and found.attachments == {"rig.toml": 11}
    assert found.state is (LogState.WHOLE if with_index else LogState.UNINDEXED)
    assert found.readable_bytes <= found.size_bytes == path.stat().st_size and found.broken == 0


def test_a_log_that_is_written_says_so(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(2))
    with path.open("rb") as file:
        lock(file)
        assert read_log_info(path).state is LogState.WRITTEN
    assert read_log_info(path).state is LogState.WHOLE


def test_a_cut_log_has_what_is_before(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(10), chunk_size=700)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = read_log_info(path)
    assert found.state is LogState.BROKEN and 0 < found.messages < 20 and found.span_ns is not None
    assert found.span_ns[0] == SPAN_NS[0] and found.span_ns[1] < SPAN_NS[1]


def test_no_log_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_bytes(b"nothing")
    with pytest.raises(DriverError):
        read_log_info(tmp_path / "log.mcap")
