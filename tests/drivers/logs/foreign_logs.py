"""Logs in other formats, and what a reader gives of them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from tests.drivers.logs.mcap_logs import LOWER, STORE, Entry, pairs, write_log

PAIRS = 12


def contents(frames: list[Frame]) -> list[tuple[str, int, int, bytes]]:
    return [(frame.camera, frame.seq, frame.stamp_ns, bytes(frame.data)) for frame in frames]


def read(path: Path, **options: Any) -> tuple[list[tuple[str, int, int, bytes]], LogReader]:
    with closing(LogReader(path, **options)) as reader:
        return contents(list(reader.frames())), reader


def expected(tmp_path: Path, entries: list[Entry] | None = None) -> list[tuple[str, int, int, bytes]]:
    return read(write_log(tmp_path / "expected.mcap", entries or pairs(PAIRS)))[0]


def write_folders(top: Path, entries: list[Entry], names: Callable[[int], str] = str) -> Path:
    for entry in entries:
        folder = top / ("lower" if entry.topic == LOWER else "upper")
        folder.mkdir(parents=True, exist_ok=True)
        message = STORE.deserialize_cdr(entry.data, entry.type)
        (folder / f"{names(entry.log_time_ns)}.jpg").write_bytes(message.data.tobytes())
    return top
