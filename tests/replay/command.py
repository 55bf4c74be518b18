"""Calls of the command line in this process, with its output."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest
from mcap.reader import make_reader

from omnid.cli import main


class Result(NamedTuple):
    code: int
    out: str
    err: str

    def count(self, name: str) -> int:
        """Return a counter of the summary, such as `pairs`, `late`, `unpaired_lower`."""
        found = re.search(rf"\b{name} +(\d+)", self.out)
        assert found, f"{name} is not in:\n{self.out}"
        return int(found[1])


class Command:
    """The command line as a function."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *words: object) -> Result:
        self._capsys.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as ended:
            code = int(ended.code or 0)
        return Result(code, *self._capsys.readouterr())

    def replay(self, log: Path, *words: object, rig: Path | None = None) -> Result:
        """Run `omnid replay` without progress, with all counters."""
        return self("replay", log, *(["--rig", rig] if rig else []), "--quiet", "--verbose", *words)

    def refused(self, *words: object) -> str:
        """Return the line with which the command refuses its input; fail if there is any other output."""
        code, out, err = self(*words)
        assert code == 2 and out == "" and err.count("\n") == 1 and err.startswith("omnid: "), (code, out, err)
        return err


def recorded(log: Path, topic: str) -> list[bytes]:
    """Return the messages of a topic of a recording."""
    with log.open("rb") as file:
        return [message.data for _, _, message in make_reader(file).iter_messages([topic])]


def attached(log: Path) -> dict[str, bytes]:
    """Return the files attached to a recording by their names."""
    with log.open("rb") as file:
        return {attachment.name: attachment.data for attachment in make_reader(file).iter_attachments()}


def rows(tum: Path) -> Sequence[str]:
    """Return the lines of a trajectory; fail if one is not whole."""
    text = tum.read_text("ascii")
    assert text == "" or text.endswith("\n")
    assert all(len(line.split()) == 8 for line in text.splitlines())
    return text.splitlines()
