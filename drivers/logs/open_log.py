"""Choice of the reader for a log, by its first bytes or by what its folder contains."""

from __future__ import annotations

import os
import re
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final

from drivers.errors import DriverError
from drivers.logs.bags import Ros1Bag, SqliteBag
from drivers.logs.image_folder import ImageFolder, image_folders
from drivers.logs.log import Log, LogFile, listed
from drivers.logs.mcap_file import McapFile
from drivers.logs.mcap_writer import is_locked

LOG_SUFFIXES: Final = (".mcap", ".db3", ".bag")
# A log: name, time of its first message (of omnid's recordings and of ROS 1), number of the part, format.
_NAME: Final = re.compile(
    r"(?P<name>.+?)(?:_\d{8}T\d{6}Z|_\d{4}(?:-\d{2}){5})?(?:_(?P<part>\d{1,9}))?(?P<format>\.(?:mcap|db3|bag))"
)
_FORMATS: Final = (McapFile, SqliteBag, Ros1Bag)


def is_log_name(name: str) -> bool:
    """True if a file is a log by its name."""
    return _NAME.fullmatch(name) is not None


def open_log(path: str | os.PathLike[str], rate_hz: float = 0.0) -> Log:
    """Open a log. Raise DriverError, which names the supported kinds, for anything else.

    path: an MCAP file, an SQLite bag of ROS 2 (.db3), a bag of ROS 1 (.bag), a folder with one of these or with the
    parts of one, or a folder with a folder of images for each camera. rate_hz: see `ImageFolder`.
    """
    given = Path(path)
    parts = [given]
    if given.is_dir():
        try:
            logs = logs_in(given)
            parts = parts_in_order(logs)
            folders = [] if logs else image_folders(given)
        except OSError as error:
            raise DriverError(f"cannot read the folder {str(given)!r}: {error.strerror}") from error
        if folders:
            return Log(given, [ImageFolder(given, folders, rate_hz)])
        if not parts:
            raise DriverError(
                f"{str(given)!r} must contain one log ({' '.join(LOG_SUFFIXES)}, unpacked), the numbered parts of one, "
                f"or a folder of images for each camera; found: {listed((log.name for log in logs), 'none')}; give one "
                "file"
            )
    with ExitStack() as opened:
        files = [opened.enter_context(closing(_open_file(part))) for part in parts]
        log = Log(given, files)
        opened.pop_all()
    return log


def _open_file(path: Path) -> LogFile:
    """Open a log by its first bytes."""
    start = b""
    try:
        if not path.exists() or path.is_file():  # a pipe would be waited for
            with path.open("rb") as file:
                start = file.read(max(len(kind.magic) for kind in _FORMATS))
    except OSError as error:
        raise DriverError(f"cannot read the log {str(path)!r}: {error.strerror}") from error
    for kind in _FORMATS:
        if start.startswith(kind.magic):
            return kind(path)
    found = f"it starts with {start!r}" if start else "it is empty, or no regular file"
    raise DriverError(
        f"{str(path)!r} is no log: {found}: give one of {', '.join(LOG_SUFFIXES)}, unpacked if it was compressed"
    )


def logs_in(folder: Path) -> list[Path]:
    """Return the logs in a folder by their names, without those being written. Raise OSError where it is unreadable."""
    files = sorted(folder.iterdir())
    return [file for file in files if is_log_name(file.name) and file.is_file() and not is_locked(file)]


def parts_in_order(logs: list[Path]) -> list[Path]:
    """Return the parts of a log in the order of their numbers, none where the files are not such parts.

    Parts have one name and consecutive numbers: `bag_0.mcap`, `bag_1.mcap`, as `ros2 bag record` names them. A single
    log is its only part.
    """
    matches = [(log, match) for log in logs if (match := _NAME.fullmatch(log.name))]
    found = {int(match["part"] or -1): log for log, match in matches}
    numbers, names = sorted(found), {(match["name"], match["format"]) for _, match in matches}
    if len(names) != 1 or numbers != list(range(numbers[0], numbers[0] + len(logs))) or (numbers[0] < 0 and logs[1:]):
        return []
    return [found[number] for number in numbers]
