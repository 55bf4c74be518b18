"""Choice of the reader for a log, by its first bytes or by what its folder contains; the contents of any log."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final

from drivers.errors import DriverError
from drivers.logs.bags import ROS1_MAGIC, SQLITE_MAGIC, Ros1Bag, SqliteBag
from drivers.logs.file_lock import is_locked
from drivers.logs.image_folder import ImageFolder, image_folders
from drivers.logs.log import Log, LogDamage, LoggedMessage, LogInfo, LogState, widened
from drivers.logs.mcap_file import McapFile

MAX_PARTS: Final = 1000
_MAX_LISTED: Final = 8
LOG_SUFFIXES: Final = (".mcap", ".db3", ".bag")
# A part of a split log: name, time of its first message (of omnid's recordings and of ROS 1), number.
_PART: Final = re.compile(r"(.+?)(_\d{8}T\d{6}Z|_\d{4}(?:-\d{2}){5})?_(\d{1,9})(\.\w+?)(?:\.part)?")
_WHOLE_OR_CUT: Final = (*LOG_SUFFIXES, ".mcap.part")  # A recording has the latter until it is complete.


def open_log(path: str | os.PathLike[str], rate_hz: float = 0.0) -> Log:
    """Open a log. Raise DriverError, which names the supported kinds, for anything else.

    path: an MCAP file, an SQLite bag of ROS 2 (.db3), a bag of ROS 1 (.bag), a folder with one of these or with the
    parts of one, or a folder with a folder of images for each camera. rate_hz: see `ImageFolder`.
    """
    given = Path(path)
    return _open_folder(given, rate_hz) if given.is_dir() else _open_file(given)


def log_info(path: str | os.PathLike[str]) -> LogInfo:
    """Return the contents of a log of any format; one without an index is read to its end.

    Raise DriverError without a log.
    """
    locked = is_locked(path)  # before it is read: the writer may end in the meantime
    with closing(open_log(path)) as log:
        counts, span_ns = log.counts(), log.span_ns()
        is_indexed = counts is not None
        if counts is None or log.damage().cut:
            counts, span_ns = Counter[str](), None
            for message in log.messages():
                counts[message.topic] += 1
                span_ns = widened(span_ns, message.log_time_ns)
        broken, cut, readable_bytes = log.damage()
        state = LogState.BROKEN if cut or broken else LogState.WHOLE if is_indexed else LogState.UNINDEXED
        size_bytes = _size_bytes(Path(path))
        return LogInfo(
            Path(path),
            size_bytes,
            LogState.WRITTEN if locked else state,
            size_bytes if readable_bytes is None else readable_bytes,
            broken,
            {name: (kind, counts.get(name, 0)) for name, kind in sorted(log.topics().items())},
            span_ns,
            {name: len(data) for name, data in log.attachments().items()},
        )


def _size_bytes(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _open_file(path: Path) -> Log:
    try:
        if path.exists() and not path.is_file():
            raise DriverError(f"cannot read the log {str(path)!r}: it is no regular file; give a log of {LOG_SUFFIXES}")
        with path.open("rb") as file:
            start = file.read(max(len(SQLITE_MAGIC), len(ROS1_MAGIC)))
    except OSError as error:
        raise DriverError(f"cannot read the log {str(path)!r}: {error.strerror}") from error
    if start.startswith(SQLITE_MAGIC):
        return SqliteBag(path)
    return Ros1Bag(path) if start.startswith(ROS1_MAGIC) else McapFile(path)


def _open_folder(path: Path, rate_hz: float) -> Log:
    try:
        logs = logs_in(path)
    except OSError as error:
        raise DriverError(f"cannot read the folder {str(path)!r}: {error.strerror}") from error
    if len(logs) == 1:
        return _open_file(logs[0])
    if parts := parts_in_order(logs):
        return _open_parts(path, parts)
    if not logs and (folders := image_folders(path)):
        return ImageFolder(path, folders, rate_hz)
    names = ", ".join(log.name for log in logs[:_MAX_LISTED]) or "none"
    raise DriverError(
        f"{str(path)!r} must contain one log ({' '.join(LOG_SUFFIXES)}), the numbered parts of one, or a "
        f"folder of images for each camera; found: {names}; give one file"
    )


def logs_in(folder: Path) -> list[Path]:
    """Return the logs in a folder by their names. Raise OSError where it is unreadable.

    A recording that was cut is one of them, unless it was completed, or is being written.
    """
    found = sorted(file for file in folder.iterdir() if file.name.endswith(_WHOLE_OR_CUT) and file.is_file())
    return [
        file for file in found if file.suffix in LOG_SUFFIXES or not (file.with_suffix("").exists() or is_locked(file))
    ]


def parts_in_order(logs: list[Path]) -> list[Path]:
    """Return the parts of a split log in the order of their numbers; empty where the files are not such parts.

    They have one name and numbers without a gap: `bag_0.mcap`, `bag_1.mcap`, as `ros2 bag record` names them. Where
    their names have times, these rise with the numbers: else the files are of several recordings.
    """
    found = [(_PART.fullmatch(log.name), log) for log in logs]
    numbered = sorted((int(match[3]), match[2] or "", log) for match, log in found if match)
    names = {(match[1], match[4]) for match, _ in found if match}
    first = numbered[0][0] if numbered else 0
    follows = [number for number, _, _ in numbered] == list(range(first, first + len(logs)))
    times = [time for _, time, _ in numbered]
    return [log for _, _, log in numbered] if len(names) == 1 and follows and times == sorted(times) else []


def _open_parts(path: Path, parts: list[Path]) -> Log:
    if len(parts) > MAX_PARTS:
        raise DriverError(f"{str(path)!r} contains {len(parts)} parts of a log; at most {MAX_PARTS} can be read as one")
    with ExitStack() as opened:
        logs = [opened.enter_context(closing(_open_file(part))) for part in parts]
        opened.pop_all()
    return SplitLog(str(path), logs)


class SplitLog:
    """A Log of parts, which it closes."""

    def __init__(self, name: str, parts: Sequence[Log]) -> None:
        """parts: in the order of time."""
        self.name = name
        self._parts = parts

    def topics(self) -> Mapping[str, str]:
        """Return name -> type of the topics of all parts."""
        found: dict[str, str] = {}
        for part in self._parts:
            for name, kind in part.topics().items():
                found[name] = found.get(name) or kind
        return found

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic; None where a part does not state it."""
        counts = [part.counts() for part in self._parts]
        return None if None in counts else sum((Counter(found) for found in counts if found), Counter[str]())

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time of the parts that have messages."""
        spans = [span_ns for part in self._parts if (span_ns := part.span_ns()) is not None]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of one part after the other."""
        for part in self._parts:
            yield from part.messages(topics)

    def attachments(self) -> dict[str, bytes]:
        """Return the attachments of the first part that has some."""
        return next((found for found in (part.attachments() for part in self._parts) if found), {})

    def damage(self) -> LogDamage:
        """Return the faults of all parts."""
        found = [part.damage() for part in self._parts]
        cut = "; ".join(damage.cut for damage in found if damage.cut)
        return LogDamage(sum(damage.broken for damage in found), cut)

    def close(self) -> None:
        """Close all parts."""
        for part in self._parts:
            part.close()
