"""Texts from outside as they are shown."""

from __future__ import annotations

import os

import pytest

from omnid.plain_text import MOST_CHARACTERS, one_line, plain


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("room 1/größe.mcap", "room 1/größe.mcap"),
        ("\x1b[2J\n\t\0\x9b", r"\x1b[2J\n\t\x00\x9b"),
        (os.fsdecode(b"a\xff\x80"), r"a\xff\x80"),
        ("\ud800\u202e\u2028", r"\ud800\u202e\u2028"),
        ("", ""),
    ],
)
def test_what_is_not_printable_is_escaped(text: str, shown: str) -> None:
    assert plain(text) == shown and shown.isprintable()


def test_a_message_is_one_line_of_limited_length() -> None:
    assert one_line(ValueError(" two\r\nlines \x07 ")) == r"two lines \x07"
    assert len(plain("\0" * 1000)) == len(one_line("x" * 1000)) == MOST_CHARACTERS and plain("abc", 2) == "ab"
