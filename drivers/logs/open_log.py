"""Choice of the reader for a log, by its first bytes or by what its folder contains; the contents of any log."""

from __future__ import annotations

import heapq
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final

from drivers.errors import DriverError
from drivers.logs import mcap_file, ros1_bag, sqlite_bag
from drivers.logs.file_lock import is_locked
from drivers.logs.file_order import LATEST_NS
from drivers.logs.image_folder import ImageFolder, image_folders
from drivers.logs.log import Log, LogDamage, LoggedMessage, LogInfo, LogState, widened
from drivers.logs.mcap_file import McapFile
from drivers.logs.packed_file import PACKED_SUFFIXES, is_packed, scratch_folder, unpack
from drivers.logs.ros1_bag import Ros1Bag
from drivers.logs.sqlite_bag import SqliteBag

MAX_PARTS: Final = 1000
_MAX_LISTED: Final = 8
LOG_SUFFIXES: Final = (".mcap", ".db3", ".bag")
_UNFINISHED: Final = (".part", ".active")  # A recording of omnid, or of rosbag, has these until it is complete.
# A log: name, time of its first message (of omnid's recordings and of ROS 1), number of the part, format.
_NAME: Final = re.compile(
    r"(.+?)(_\d{8}T\d{6}Z|_\d{4}(?:-\d{2}){5})?(?:_(\d{1,9}))?(\.(?:mcap|db3|bag))"
    rf"(?:{'|'.join(map(re.escape, (*_UNFINISHED, *PACKED_SUFFIXES)))})*"
)
_MAX_METADATA_BYTES: Final = 2**20
_LISTED_FILES: Final = re.compile(r"^ *relative_file_paths:[ \t]*\n((?:[ \t]*- .*\n)*)", re.M)
_FORMATS: Final[dict[bytes, Callable[[Path, str], Log]]] = {
    mcap_file.MAGIC: McapFile,
    sqlite_bag.MAGIC: SqliteBag,
    ros1_bag.MAGIC: Ros1Bag,
}


def is_log_name(name: str) -> bool:
    """True if a file is a log by its name, which may be unfinished or compressed as a whole."""
    return _NAME.fullmatch(name) is not None


def open_log(path: str | os.PathLike[str], rate_hz: float = 0.0) -> Log:
    """Open a log. Raise DriverError, which names the supported kinds, for anything else.

    path: an MCAP file, an SQLite bag of ROS 2 (.db3), a bag of ROS 1 (.bag), a folder with one of these or with the
    parts of one, or a folder with a folder of images for each camera. rate_hz: see `ImageFolder`.
    """
    given = Path(path)
    return _open_folder(given, rate_hz) if given.is_dir() else _open_file(given)


def log_info(path: str | os.PathLike[str], *, examine: bool = False) -> LogInfo:
    """Return the contents of a log of any format.

    examine: read it to its end, as one without an index is; otherwise corrupt chunks are not noticed. Raise DriverError
    without a log.
    """
    locked = is_locked(path)  # before it is read: the writer may end in the meantime
    with closing(open_log(path)) as log:
        counts, span_ns = log.counts(), log.span_ns()
        is_indexed = counts is not None
        if examine or counts is None or log.damage().cut:
            counts, span_ns = Counter[str](), None
            for message in log.messages():
                counts[message.topic] += 1
                span_ns = widened(span_ns, message.log_time_ns)
        broken, cut = log.damage()
        state = LogState.BROKEN if cut or broken else LogState.WHOLE if is_indexed else LogState.UNINDEXED
        return LogInfo(
            Path(path),
            _size_bytes(Path(path)),
            LogState.WRITTEN if locked else state,
            broken,
            cut,
            {name: (kind, counts.get(name, 0)) for name, kind in sorted(log.topics().items())},
            span_ns,
            {name: len(data) for name, data in log.attachments().items()},
        )


def _size_bytes(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _open_file(path: Path, name: str | None = None) -> Log:
    """Open a log by its first bytes; name: for error messages, where it is not the path."""
    name = name or str(path)
    try:
        if path.exists() and not path.is_file():
            raise DriverError(f"cannot read the log {name!r}: it is no regular file; give a log of {LOG_SUFFIXES}")
        with path.open("rb") as file:
            start = file.read(max(map(len, _FORMATS)))
    except OSError as error:
        raise DriverError(f"cannot read the log {name!r}: {error.strerror}") from error
    for magic, kind in _FORMATS.items():
        if start.startswith(magic):
            return kind(path, name)
    if is_packed(start) and name == str(path):
        with scratch_folder(name) as folder:
            inside = unpack(path, folder)
            if not inside.stat().st_size:
                raise DriverError(f"{name!r} is compressed, but cut or corrupt at its start: record it again")
            return _open_file(inside, name)
    found = f"it starts with {start!r}: give a log of {LOG_SUFFIXES}" if start else "it is empty: record it again"
    raise DriverError(f"{name!r} is no log: {found}")


def _open_folder(path: Path, rate_hz: float) -> Log:
    try:
        logs = logs_in(path)
        missing = _missing(path, logs)
    except OSError as error:
        raise DriverError(f"cannot read the folder {str(path)!r}: {error.strerror}") from error
    if len(logs) == 1 and not missing:
        return _open_file(logs[0])
    if parts := parts_in_order(logs, with_gaps=True):
        return _open_parts(path, parts, missing)
    if not logs and (folders := image_folders(path)):
        return ImageFolder(path, folders, rate_hz)
    names = ", ".join(log.name for log in logs[:_MAX_LISTED]) or "none"
    raise DriverError(
        f"{str(path)!r} must contain one log ({' '.join(LOG_SUFFIXES)}), the numbered parts of one, or a "
        f"folder of images for each camera; found: {names}; give one file"
    )


def logs_in(folder: Path) -> list[Path]:
    """Return the logs in a folder by their names. Raise OSError where it is unreadable.

    One that was cut, or is compressed, is one of them, unless it is there completed or unpacked, or is being written.
    """
    found = sorted(file for file in folder.iterdir() if is_log_name(file.name) and file.is_file())
    return [
        file
        for file in found
        if file.suffix in LOG_SUFFIXES
        or not (file.with_suffix("").exists() or (file.suffix in _UNFINISHED and is_locked(file)))
    ]


def parts_in_order(logs: list[Path], *, with_gaps: bool = False) -> list[Path]:
    """Return the parts of a split log in the order of their numbers; empty where the files are not such parts.

    They have one name and numbers: `bag_0.mcap`, `bag_1.mcap`, as `ros2 bag record` names them, without a gap unless
    with_gaps. Where their names have times, these rise with the numbers: else the files are of several recordings.
    """
    found = [(_NAME.fullmatch(log.name), log) for log in logs]
    numbered = sorted((int(match[3]), match[2] or "", log) for match, log in found if match and match[3])
    names = {(match[1], match[4]) for match, _ in found if match}
    numbers, times = [number for number, _, _ in numbered], [time for _, time, _ in numbered]
    follows = numbers == list(range(numbers[0], numbers[0] + len(logs))) if numbers else False
    is_one = len(names) == 1 and len(set(numbers)) == len(logs) and times == sorted(times)
    return [log for _, _, log in numbered] if is_one and (follows or with_gaps) else []


def _missing(folder: Path, logs: Sequence[Path]) -> list[str]:
    """Return the parts of a log that are not there: by metadata.yaml of rosbag2, else by a gap in their numbers."""
    metadata = folder / "metadata.yaml"
    there = {match[0] for log in logs if (match := _NAME.match(log.name))}
    if metadata.is_file() and metadata.stat().st_size <= _MAX_METADATA_BYTES:
        listed = _LISTED_FILES.search(metadata.read_text("utf-8", "replace"))
        # The first versions of rosbag2 listed paths.
        lines = listed[1].splitlines() if listed else []
        names = [Path(line.strip().removeprefix("- ").strip("'\" ")).name for line in lines]
        plain = {name[: match.end(4)] for name in there if (match := _NAME.match(name))}
        return [name for name in names if not ((match := _NAME.match(name)) and name[: match.end(4)] in plain)]
    numbers = {int(match[3]): match for log in logs if (match := _NAME.fullmatch(log.name)) and match[3]}
    first = next(iter(numbers.values()), None)
    if first is None or len(numbers) != len(logs):
        return []
    gaps = set(range(min(numbers), max(numbers))) - numbers.keys()
    return [f"{first[1]}_{number}{first[4]}" for number in sorted(gaps)[:MAX_PARTS]]


def _open_parts(path: Path, parts: list[Path], missing: Sequence[str]) -> Log:
    if len(parts) > MAX_PARTS:
        raise DriverError(f"{str(path)!r} contains {len(parts)} parts of a log; at most {MAX_PARTS} can be read as one")
    with ExitStack() as opened:
        logs = [opened.enter_context(closing(_open_file(part))) for part in parts]
        opened.pop_all()
    return SplitLog(str(path), logs, missing)


class SplitLog:
    """A Log of parts, which it closes."""

    def __init__(self, name: str, parts: Sequence[Log], missing: Sequence[str] = ()) -> None:
        """parts: in the order of time; missing: names of those that are not there."""
        self.name = name
        self._parts, self._missing = parts, missing

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

    def image_spans_ns(self) -> Mapping[str, tuple[int, int]]:
        """Return the first and last log time of each topic of images."""
        found: dict[str, tuple[int, int]] = {}
        for part in self._parts:
            for topic, span_ns in part.image_spans_ns().items():
                found[topic] = widened(widened(found.get(topic), span_ns[0]), span_ns[1])
        return found

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of all parts in the order of log time.

        Where a topic of images goes back from one part to the next, the clock was set: what follows comes afterwards.
        """
        segments, ends_ns = list[list[tuple[int, int, Log]]](), dict[str, int]()
        for number, part in enumerate(self._parts):
            spans_ns = part.image_spans_ns()
            if not segments or any(first_ns < ends_ns.get(topic, 0) for topic, (first_ns, _) in spans_ns.items()):
                segments.append([])
                ends_ns.clear()
            begin_ns = min((first_ns for first_ns, _ in spans_ns.values()), default=0)
            segments[-1].append((begin_ns, number, part))
            ends_ns |= {topic: last_ns for topic, (_, last_ns) in spans_ns.items()}
        for segment in segments:
            yield from _merged([(begin_ns, part) for begin_ns, _, part in sorted(segment)], topics)

    def attachments(self) -> dict[str, bytes]:
        """Return the attachments of the first part that has some."""
        return next((found for found in (part.attachments() for part in self._parts) if found), {})

    def damage(self) -> LogDamage:
        """Return the faults of all parts."""
        found = [part.damage() for part in self._parts]
        faults = [damage.cut for damage in found if damage.cut]
        if self._missing:
            more = f" and {len(self._missing) - _MAX_LISTED} more" if len(self._missing) > _MAX_LISTED else ""
            listed = ascii(", ".join(self._missing[:_MAX_LISTED]))[1:-1]
            faults.insert(0, f"parts of the log {self.name!r} are missing: {listed}{more}: used the others")
        cut = "; ".join(faults)
        return LogDamage(sum(damage.broken for damage in found), cut)

    def close(self) -> None:
        """Close all parts."""
        for part in self._parts:
            part.close()


def _merged(parts: Sequence[tuple[int, Log]], topics: Collection[str] | None) -> Iterator[LoggedMessage]:
    """Yield the messages of logs, which are in the order of their begins [ns], by time; open each when it is due."""
    waiting: list[tuple[int, int, LoggedMessage, Iterator[LoggedMessage]]] = []

    def add_next(number: int, messages: Iterator[LoggedMessage]) -> None:
        for message in messages:
            heapq.heappush(waiting, (message.log_time_ns, number, message, messages))
            return

    for number, (begin_ns, part) in enumerate([*parts, (LATEST_NS, None)]):
        while waiting and waiting[0][0] < begin_ns:
            _, earlier, message, messages = heapq.heappop(waiting)
            yield message
            add_next(earlier, messages)
        if part is not None:
            add_next(number, part.messages(topics))
