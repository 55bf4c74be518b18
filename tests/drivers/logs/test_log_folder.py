"""The folder of recordings: unused names, the oldest files are deleted, the disk keeps free space."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import DriverError
from drivers.logs.file_lock import lock
from drivers.logs.log_folder import LogFolder, complete_path

STAMP_NS = 1_700_000_000 * 10**9
NAME = "robot_20231114T221320Z"


def test_a_path_is_unused_by_whole_and_unfinished_files(tmp_path: Path) -> None:
    folder = LogFolder(tmp_path, "robot")
    assert folder.unused_path(STAMP_NS, 1) == (tmp_path / f"{NAME}_001.mcap.part", 1)
    (tmp_path / f"{NAME}_001.mcap").touch()
    (tmp_path / f"{NAME}_002.mcap.part").symlink_to("nowhere")
    path, number = folder.unused_path(STAMP_NS, 1)
    assert (path.name, number, complete_path(path).name) == (f"{NAME}_003.mcap.part", 3, f"{NAME}_003.mcap")


def test_a_name_cannot_leave_the_folder(tmp_path: Path) -> None:
    path, _ = LogFolder(tmp_path, "../a b/c").unused_path(STAMP_NS, 1)
    assert path.parent == tmp_path and path.name.startswith("..-a-b-c_2023")


def test_the_oldest_files_of_this_name_are_deleted(tmp_path: Path) -> None:
    others = ["notes.txt", "other_20200101T000000Z_001.mcap", f"{NAME}_001.mcap.bak"]
    own = [f"{NAME}_{number:03}.mcap" for number in range(1, 5)]
    for name in (*others, *own):
        (tmp_path / name).write_bytes(bytes(100))
    folder = LogFolder(tmp_path, "robot")
    assert folder.delete_oldest(3, 10**6) == 1 and folder.delete_oldest(9, 250) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, *own[2:]])


def test_a_file_that_is_written_is_kept(tmp_path: Path) -> None:
    for number in (1, 2):
        (tmp_path / f"{NAME}_{number:03}.mcap.part").write_bytes(b"x")
    with (tmp_path / f"{NAME}_001.mcap.part").open("rb") as file:
        lock(file)
        assert LogFolder(tmp_path, "robot").delete_oldest(0, 0) == 1
    assert [path.name for path in tmp_path.iterdir()] == [f"{NAME}_001.mcap.part"]


def test_the_folder_is_made_and_free_space_is_required(tmp_path: Path) -> None:
    LogFolder(tmp_path / "new", "robot").require_free_space(1)
    assert (tmp_path / "new").is_dir()
    with pytest.raises(DriverError, match=f"MB are free and {10**12} needed"):
        LogFolder(tmp_path, "robot").require_free_space(10**18)
    with pytest.raises(DriverError, match="No such file or directory; name another folder"):
        LogFolder(tmp_path / "a" / "b", "robot").require_free_space(1)
