"""Folders of images with stamps, one folder for each camera."""

from __future__ import annotations

import pytest

from drivers.logs.image_folder import parse_stamp


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1403636579763555584", 1403636579763555584),
        ("1305031102.175304", 1305031102175304000),
        ("1305031102.1753041239", 1305031102175304123),
        ("7", 7_000_000_000),
        ("4611686018.427387903", 2**62 - 1),
        ("4611686018.427387904", None),
        ("1.036336e-01", 103_633_600),
        ("12_05_59", None),
        ("10_1", None),
        ("2011-09-26T13:02:25+02:00", 1317034945000000000),
        ("2011-09-26 13:02:25.951199337", 1317042145951199337),
        ("2011-09-26T13:02:25", 1317042145000000000),
        ("frame1", None),
        ("", None),
        ("-1", None),
        ("nan", None),
        ("1e30", None),
        ("9" * 400, None),
        ("1.2.3", None),
        ("2011-09-26 13:02:25.x", None),
        ("1969-01-01", None),
    ],
)
def test_stamps_are_exact(text: str, stamp_ns: int | None) -> None:
    assert parse_stamp(text) == stamp_ns
