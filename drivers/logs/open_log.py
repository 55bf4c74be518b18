"""Choice of the reader for a log, by its first bytes or by what its folder contains; the contents of any log."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from drivers.errors import DriverError
from drivers.logs.image_folder import ImageFolder, image_folders
from drivers.logs.log import MAX_ATTACHMENT_BYTES, MAX_LISTED, Log, LogFile
from drivers.logs.mcap_file import MAGIC as MCAP_MAGIC
from drivers.logs.mcap_file import McapFile
from drivers.logs.mcap_writer import is_locked
from drivers.logs.ros1_bag import MAGIC as BAG_MAGIC
from drivers.logs.ros1_bag import Ros1Bag
from drivers.logs.sqlite_bag import MAGIC as SQLITE_MAGIC
from drivers.logs.sqlite_bag import SqliteBag

MAX_PARTS: Final = 1000
LOG_SUFFIXES: Final = (".mcap", ".db3", ".bag")
# A log: name, time of its first message (of omnid's recordings and of ROS 1), number of the part, format. Until it is
# complete, a recording of omnid ends with .part, and one of rosbag with .active.
_NAME: Final = re.compile(
    r"(?P<log>(?P<name>.+?)(?P<time>_\d{8}T\d{6}Z|_\d{4}(?:-\d{2}){5})?(?:_(?P<part>\d{1,9}))?"
    r"(?P<format>\.(?:mcap|db3|bag)))(?:\.part|\.active)?"
)
_LISTED_FILES: Final = re.compile(r"^ *relative_file_paths:[ \t]*\n((?:[ \t]*- .*\n)*)", re.M)
_FORMATS: Final[dict[bytes, Callable[[Path, str], LogFile]]] = {
    MCAP_MAGIC: McapFile,
    SQLITE_MAGIC: SqliteBag,
    BAG_MAGIC: Ros1Bag,
}


def is_log_name(name: str) -> bool:
    """True if a file is a log by its name, which may be unfinished."""
    return _NAME.fullmatch(name) is not None


def open_log(path: str | os.PathLike[str], rate_hz: float = 0.0) -> Log:
    """Open a log. Raise DriverError, which names the supported kinds, for anything else.

    path: an MCAP file, an SQLite bag of ROS 2 (.db3), a bag of ROS 1 (.bag), a folder with one of these or with the
    parts of one, or a folder with a folder of images for each camera. rate_hz: see `ImageFolder`.
    """
    given = Path(path)
    return _open_folder(given, rate_hz) if given.is_dir() else Log(str(given), [_open_file(given)])


class LogState(Enum):
    """State of a log; the values are shown to the user."""

    WHOLE = "whole"
    WRITTEN = "being written"
    BROKEN = "cut or corrupt"


@dataclass(frozen=True, slots=True)
class LogInfo:
    """Contents of a log."""

    path: Path
    size_bytes: int
    state: LogState
    broken: int  # corrupt chunks and records; those that nothing but reading shows are 0 where it was not examined
    fault: str  # one line that says what of the log is missing; empty for a complete log
    topics: Mapping[str, tuple[str, int]]  # topic -> type ('' where it cannot be decoded), number of messages
    rates_hz: Mapping[str, float]  # topic -> mean rate from its first message to its last one; two are needed
    span_ns: tuple[int, int] | None  # first and last log time; None without messages
    attachments: Mapping[str, int]  # name -> bytes of the readable ones

    @property
    def messages(self) -> int:
        """Number of messages of all topics."""
        return sum(count for _, count in self.topics.values())


def log_info(path: str | os.PathLike[str], *, examine: bool = False, rate_hz: float = 0.0) -> LogInfo:
    """Return the contents of a log of any format.

    examine: read it to its end; otherwise corrupt chunks are not noticed. rate_hz: see `ImageFolder`. Raise
    DriverError without a log.
    """
    locked, given = is_locked(path), Path(path)  # before it is read: the writer may end in the meantime
    with closing(open_log(path, rate_hz)) as log:
        counts = Counter(message.topic for message in log.messages()) if examine else log.counts()
        damage, index = log.damage(), log.index
        logged_ns = index.entries["time_ns"]
        times = {name: logged_ns[index.topic == n] for n, name in enumerate(index.topics)}
        files = given.rglob("*") if given.is_dir() else [given]
        return LogInfo(
            given,
            sum(file.stat().st_size for file in files if file.is_file()),
            LogState.WRITTEN if locked else LogState.BROKEN if damage.cut or damage.broken else LogState.WHOLE,
            damage.broken,
            damage.cut,
            {name: (kind, counts.get(name, 0)) for name, kind in sorted(index.topics.items())},
            {name: (len(ns) - 1) * 1e9 / float(np.ptp(ns)) for name, ns in times.items() if len(ns) and np.ptp(ns)},
            (int(logged_ns.min()), int(logged_ns.max())) if logged_ns.size else None,
            {name: len(data) for name, data in log.attachments().items()},
        )


def _open_file(path: Path) -> LogFile:
    """Open a log by its first bytes."""
    try:
        if path.exists() and not path.is_file():
            raise DriverError(
                f"cannot read the log {str(path)!r}: it is no regular file; give one of {', '.join(LOG_SUFFIXES)}"
            )
        with path.open("rb") as file:
            start = file.read(max(map(len, _FORMATS)))
    except OSError as error:
        raise DriverError(f"cannot read the log {str(path)!r}: {error.strerror}") from error
    for magic, kind in _FORMATS.items():
        if start.startswith(magic):
            return kind(path, str(path))
    found = f"it starts with {start!r}" if start else "it is empty"
    raise DriverError(
        f"{str(path)!r} is no log: {found}: give one of {', '.join(LOG_SUFFIXES)}, unpacked if it was compressed"
    )


def _open_folder(path: Path, rate_hz: float) -> Log:
    try:
        logs = logs_in(path)
        missing = _missing(path, logs)
    except OSError as error:
        raise DriverError(f"cannot read the folder {str(path)!r}: {error.strerror}") from error
    parts = logs if len(logs) == 1 and not missing else parts_in_order(logs, with_gaps=True)
    if len(parts) > MAX_PARTS:
        raise DriverError(f"{str(path)!r} contains {len(parts)} parts of a log; at most {MAX_PARTS} can be read as one")
    if parts:
        with ExitStack() as opened:
            files = [opened.enter_context(closing(_open_file(part))) for part in parts]
            opened.pop_all()
        return Log(str(path), files, missing)
    if not logs and (folders := image_folders(path)):
        return Log(str(path), [ImageFolder(path, folders, rate_hz)])
    names = ", ".join(log.name for log in logs[:MAX_LISTED]) or "none"
    raise DriverError(
        f"{str(path)!r} must contain one log ({' '.join(LOG_SUFFIXES)}, unpacked), the numbered parts of one, or a "
        f"folder of images for each camera; found: {names}; give one file"
    )


def logs_in(folder: Path) -> list[Path]:
    """Return the logs in a folder by their names. Raise OSError where it is unreadable.

    One that was cut is one of them, unless it is there completed, or is being written.
    """
    return [
        file
        for file in sorted(folder.iterdir())
        if is_log_name(file.name)
        and file.is_file()
        and (file.suffix in LOG_SUFFIXES or not (file.with_suffix("").exists() or is_locked(file)))
    ]


def parts_in_order(logs: list[Path], *, with_gaps: bool = False) -> list[Path]:
    """Return the parts of a split log in the order of their numbers; empty where the files are not such parts.

    They have one name and numbers: `bag_0.mcap`, `bag_1.mcap`, as `ros2 bag record` names them, without a gap unless
    with_gaps. Where their names have times, these rise with the numbers: else the files are of several recordings.
    """
    found = [(match, log) for log in logs if (match := _NAME.fullmatch(log.name)) and match["part"]]
    found.sort(key=lambda entry: int(entry[0]["part"]))
    numbers, times = [int(match["part"]) for match, _ in found], [match["time"] or "" for match, _ in found]
    is_one = len({(match["name"], match["format"]) for match, _ in found}) == 1 and len(found) == len(logs)
    rises = all(before < after if with_gaps else before + 1 == after for before, after in pairwise(numbers))
    return [log for _, log in found] if is_one and rises and times == sorted(times) else []


def _missing(folder: Path, logs: Sequence[Path]) -> list[str]:
    """Return the parts of a log that are not there: by metadata.yaml of rosbag2, else by a gap in their numbers."""
    metadata = folder / "metadata.yaml"
    there = [match for log in logs if (match := _NAME.fullmatch(log.name))]
    if metadata.is_file() and metadata.stat().st_size <= MAX_ATTACHMENT_BYTES:
        listed = _LISTED_FILES.search(metadata.read_text("utf-8", "replace"))
        # The first versions of rosbag2 listed paths; what was compressed may have been unpacked.
        lines = listed[1].splitlines() if listed else []
        names = [Path(line.strip().removeprefix("- ").strip("'\" ")).name for line in lines]
        known = {match["log"] for match in there}
        return [name for name in names if name.removesuffix(".zstd") not in known]
    numbers = [int(match["part"]) for match in there if match["part"]]
    if not numbers or len(set(numbers)) != len(logs):
        return []
    gaps = sorted({*range(min(numbers), max(numbers))}.difference(numbers))
    return [f"{there[0]['name']}_{number}{there[0]['format']}" for number in gaps[:MAX_PARTS]]
