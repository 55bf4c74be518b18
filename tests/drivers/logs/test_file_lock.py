"""A file that is being written is locked, as long as it is open."""

from __future__ import annotations

from pathlib import Path

from drivers.logs.file_lock import is_locked, lock


def test_a_file_is_locked_until_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        assert not is_locked(path)
        lock(file)
        assert is_locked(path)
        with path.open("rb") as reader:
            lock(reader)  # somebody else holds it: without effect
        assert is_locked(path)
    assert not is_locked(path)


def test_what_is_no_file_is_not_locked(tmp_path: Path) -> None:
    assert not is_locked(tmp_path) and not is_locked(tmp_path / "missing")
