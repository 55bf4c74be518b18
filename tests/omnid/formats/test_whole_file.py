"""Files that are replaced at once: links are followed to the file, not replaced; strangers' temporary files are not."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from calib.atomic_file import write_file
from omnid.errors import OmnidError
from omnid.formats.place_file import read_places, write_places
from omnid.formats.whole_file import write_whole
from tests.omnid.formats.place_maps import RIG, some_places


def write_map(path: Path, content: bytes) -> None:
    write_places(path, some_places(2), RIG)


WRITERS = pytest.mark.parametrize("write", [write_whole, write_map, write_file])


@WRITERS
@pytest.mark.parametrize("exists", [True, False])
def test_a_file_is_written_where_its_link_leads(
    tmp_path: Path, write: Callable[[Path, bytes], None], exists: bool
) -> None:
    (tmp_path / "disk").mkdir()
    file, link = tmp_path / "disk" / "file", tmp_path / "link"
    if exists:
        file.write_bytes(b"old")
    link.symlink_to(file)
    write(link, b"new")
    assert link.is_symlink() and os.listdir(tmp_path / "disk") == ["file"]
    assert len(read_places(file)[0]) == 2 if write is write_map else file.read_bytes() == b"new"


@WRITERS
def test_a_link_in_the_place_of_the_temporary_file_is_not_followed(
    tmp_path: Path, write: Callable[[Path, bytes], None]
) -> None:
    victim, path = tmp_path / "victim", tmp_path / "file"
    victim.write_bytes(b"mine")
    (tmp_path / f".file.{os.getpid()}.part").symlink_to(victim)
    write(path, b"new")
    assert victim.read_bytes() == b"mine" and path.is_file() and not path.is_symlink()


def test_a_loop_of_links_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(OmnidError, match="cannot write the file"):
        write_whole(tmp_path / "a" / "file", b"new")
