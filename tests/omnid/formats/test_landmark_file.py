"""Landmark files: written and read again; whatever is wrong is one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from omnid.core.places.alignment import Landmark
from omnid.errors import OmnidError
from omnid.formats.landmark_file import read_landmarks, read_tags, write_landmarks

MARKS = [Landmark('dock "2"', 5, 0.16, (3.0, -1.25, 0.8), 1.5), Landmark("6", 6, 0.2, (0.0, 0.0, 0.0), None)]
TAG = "schema = 1\n[tag.dock]\nid = 5\nsize_m = 0.16\nxyz_m = [3, -1.25, 0.8]\n"


def test_landmarks_come_back(tmp_path: Path) -> None:
    write_landmarks(tmp_path / "a.toml", MARKS)
    found = read_landmarks(tmp_path / "a.toml")
    assert list(found) == [5, 6] and found[6] == MARKS[1]
    assert found[5].name == 'dock "2"' and found[5].facing_rad == pytest.approx(1.5, abs=1e-3)
    assert found[5].xyz_m == MARKS[0].xyz_m


@pytest.mark.parametrize(
    "name", ["K\N{LATIN SMALL LETTER U WITH DIAERESIS}che", "\N{ROBOT FACE} a\\b.c", "[x] = 'y' #"]
)
def test_any_name_comes_back(tmp_path: Path, name: str) -> None:
    write_landmarks(tmp_path / "a.toml", [replace(MARKS[1], name=name)])
    assert read_landmarks(tmp_path / "a.toml") == {6: replace(MARKS[1], name=name)}


def test_a_file_without_landmarks_can_be_read(tmp_path: Path) -> None:
    write_landmarks(tmp_path / "a.toml", [])
    assert read_landmarks(tmp_path / "a.toml") == {} == read_tags(tmp_path / "a.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "schema: expected version 1"),
        ("schema = 1\n", "tag: expected a table"),
        ("schema = 1\n[tag]\ndock = 5\n", "tag.dock: expected a table"),
        (TAG.replace("id = 5", "id = 587"), "tag.dock.id: expected a number of 0 to 586"),
        (TAG.replace("id = 5", "id = true"), "tag.dock.id: expected a number"),
        (TAG.replace("0.16", "0"), "size_m: expected an edge"),
        (TAG.replace("[3, ", "["), "xyz_m: expected 3 finite numbers"),
        (TAG + "facing = 90\n", "unknown key"),
        (TAG + TAG[11:].replace("dock", "other"), "two landmarks have the same id"),
        ("\x00", "not a TOML file"),
    ],
)
def test_wrong_files_are_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(OmnidError, match=r"a\.toml") as caught:
        read_landmarks(tmp_path / "a.toml")
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(OmnidError, match=r"none\.toml"):
        read_landmarks(tmp_path / "none.toml")
