"""The logs of a batch: found by names, folders, patterns and addresses, each with a folder for its results."""

from __future__ import annotations

import glob
import hashlib
import itertools
import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

from drivers.logs.image_folder import image_folders
from drivers.logs.log_formats import LOG_SUFFIXES, logs_in, parts_in_order
from omnid.config import PlacesConfig
from omnid.errors import OmnidError
from omnid.plain_text import one_line
from omnid.version import __version__

RESULT_FILE: Final = "result.json"
MAX_LOGS: Final = 100_000
_WILDCARDS: Final = ("*", "?", "[")
_URL: Final = re.compile(r"[a-z][a-z0-9+.-]*://")
_UNSAFE: Final = re.compile(r"[^\w.-]+")


@dataclass(frozen=True, slots=True)
class BatchOptions:
    """The same for all logs. Paths are absolute, because a worker may run elsewhere."""

    arguments: tuple[str, ...] = ()  # of `omnid replay`, in addition to log and outputs
    truth: str = "truth.txt"  # name of a trajectory in the folder of a log, which is compared where it exists; "": none
    record: bool = False  # keep a recording and a report of each log
    timeout_s: float = 3600.0  # for one log
    inputs: tuple[str, ...] = ()  # files that all replays read: see `input_files`


@dataclass(frozen=True, slots=True)
class Job:
    """One log and its folder."""

    name: str  # of the folder below that of the batch
    log: str  # path or address
    folder: Path
    options: BatchOptions

    def key(self) -> str:
        """Return a number that changes with what makes a result: with another number, a result is old.

        That is the version of omnid, the options, and the log, its truth and the inputs, by name, size and time.
        """
        paths = [*map(Path, self.options.inputs), *([] if is_url(self.log) else [Path(self.log)])]
        if (truth := self.truth()) is not None:
            paths.append(truth)
        files = [(str(file), stat.st_size, stat.st_mtime_ns) for path in paths for file, stat in _files(path)]
        state = [__version__, asdict(self.options), self.log, files]
        return hashlib.sha256(json.dumps(state).encode()).hexdigest()[:16]

    def truth(self) -> Path | None:
        """Return the true trajectory in the folder of the log, None without one, and for a log at an address."""
        if is_url(self.log) or not self.options.truth:
            return None
        log = Path(self.log)
        path = (log if log.is_dir() else log.parent) / self.options.truth
        return path if path.is_file() else None


def input_files(rig: Path | None, settings: Path | None, places: PlacesConfig) -> tuple[str, ...]:
    """Return the absolute paths of the files that all replays of a batch read. rig, settings: None: not given.

    Raises OmnidError for a map that the replays would extend: results would depend on their order.
    """
    if places.map and not places.localize_only:
        raise OmnidError(
            f"batch: expected a map that stays as it is, found {places.map!r}, which each replay would extend: add "
            "--set places.localize_only=true, or make a map of all logs by `omnid map build`"
        )
    given = [rig, settings, *(Path(name) for name in (places.tags, places.map) if name)]
    return tuple(str(path.absolute()) for path in given if path is not None)


def is_url(name: str) -> bool:
    """True if a name is an address such as s3://bucket/log.mcap."""
    return _URL.match(name) is not None


def find_logs(names: Sequence[str]) -> list[str]:
    """Return the logs of names, folders, patterns and addresses, sorted, each once; raise OmnidError without one.

    A folder that is a log itself counts as one; of others all logs below it are taken.
    """
    found = sorted({log for name in names for log in (_of_url(name) if is_url(name) else _of_name(name))})
    if len(found) > MAX_LOGS:
        raise OmnidError(f"batch: {len(found)} logs; expected {MAX_LOGS} at most; give a part of them")
    return found


def jobs(logs: Sequence[str], out: Path, options: BatchOptions) -> list[Job]:
    """Return the jobs of logs; their folders have the names of the logs below their common folder.

    A folder with the results of another log is left as it is: a number is added to the name.
    """
    paths = [
        PurePosixPath("/", _URL.sub("", log).lstrip("/")) if is_url(log) else PurePosixPath(Path(log).absolute())
        for log in logs
    ]
    common = Path(os.path.commonpath([path.parent for path in paths])) if paths else Path("/")
    # Without a dot at the beginning: names such as ".." and those of this program's own files are no folders of logs.
    names = [_UNSAFE.sub("-", str(path.relative_to(common).with_suffix(""))).lstrip(".") or "log" for path in paths]
    folders = _folders(names, logs, out)
    return [Job(folder.name, log, folder, options) for folder, log in zip(folders, logs, strict=True)]


def _folders(names: Sequence[str], logs: Sequence[str], out: Path) -> list[Path]:
    """Return a folder for each log, none twice, a.mcap and a.db3 are two logs, and none with results of another one."""
    given, found = set(names), dict[Path, None]()
    for name, log in zip(names, logs, strict=True):
        # A number that no other log has as a part of its own name.
        numbered = (each for count in itertools.count(2) if (each := f"{name}-{count}") not in given)
        folders = (out / each for each in itertools.chain([name], numbered))
        found[next(each for each in folders if each not in found and _stored_log(each) in (None, log))] = None
    return list(found)


def _stored_log(folder: Path) -> str | None:
    """Return the log of the result in a folder, None where there is none that can be read."""
    try:
        log = json.loads((folder / RESULT_FILE).read_text())["log"]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return log if isinstance(log, str) else None


def _of_name(name: str) -> list[str]:
    path = Path(name)
    if path.exists():
        paths = list(_of_path(path))
    elif any(sign in name for sign in _WILDCARDS):
        paths = [log for match in glob.glob(name, recursive=True) for log in _of_path(Path(match))]
    else:
        raise OmnidError(f"batch: no log {name!r}; give files, folders, patterns in quotes, or addresses")
    if not paths:
        kinds = f"{' '.join(LOG_SUFFIXES)}, or a folder of images for each camera"
        raise OmnidError(f"batch: no log ({kinds}) in {name!r}; give files, folders or patterns")
    return [str(log.absolute()) for log in paths]


def _of_path(path: Path) -> Iterator[Path]:
    """Yield a file, a folder with the parts of one log or with folders of images, or the logs below a folder."""
    if not path.is_dir():
        yield path
        return
    inside = logs_in(path)
    if len(inside) > 1 and parts_in_order(inside):
        yield path
        return
    # Links to folders are not followed: they may form circles.
    below = sorted(folder for folder in path.iterdir() if folder.is_dir() and not folder.is_symlink())
    found = [*inside, *(log for folder in below for log in _of_path(folder))]
    # Folders of images, one for each camera, are a log: of nested folders the lowest that holds two.
    if not found and len(image_folders(path)) > 1:
        found = [path]
    yield from found


def _of_url(name: str) -> list[str]:
    """Return the logs of an address, which may be a pattern, through fsspec."""
    files = file_system(name)
    try:
        found = files.glob(name) if any(sign in name for sign in _WILDCARDS) else [name] * files.exists(name)
        logs = [files.unstrip_protocol(path) for path in found]
    except Exception as error:  # any of the many that the file systems raise
        raise OmnidError(f"batch: {name!r} cannot be listed: {one_line(error)}") from error
    if not logs:
        raise OmnidError(f"batch: nothing at {name!r}; give files, or a pattern such as s3://bucket/2026-*/*.mcap")
    return sorted(logs)


def file_system(name: str) -> Any:
    """Return fsspec's file system of an address; raise OmnidError where it is not installed."""
    try:
        import fsspec
    except ImportError as error:
        raise OmnidError(
            f"batch: {name!r} needs fsspec, and for s3:// s3fs: install the extra `fleet` of omnid"
        ) from error
    try:
        return fsspec.core.url_to_fs(name)[0]
    except (ValueError, ImportError) as error:
        raise OmnidError(f"batch: {name!r}: {one_line(error)}") from error


def _files(path: Path) -> Iterator[tuple[Path, os.stat_result]]:
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            yield file, file.stat()
