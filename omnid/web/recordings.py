"""The recordings in a folder, and the reports about them, which a process of its own makes: `omnid report`."""

from __future__ import annotations

import asyncio
import hashlib
import os
from collections import OrderedDict
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Route

from drivers.errors import DriverError
from drivers.logs.file_lock import is_locked
from drivers.logs.log_folder import PART_SUFFIX
from drivers.logs.mcap_index import has_footer
from drivers.logs.mcap_records import LogFile
from omnid.engine.python_program import python, python_environment
from omnid.errors import OmnidError
from omnid.plain_text import one_line, plain
from omnid.web.guard import REPORT_POLICY

MOST_LISTED: Final = 500  # the newest
MOST_REPORTS: Final = 8  # Most reports that are kept.
REPORT_S: Final = 600.0  # time for a report
NICE: Final = 10  # lower priority than the daemon's
_WRONG_INPUT: Final = 2  # exit code of omnid for what the user can correct, named in its last line
_SUFFIXES: Final = (".mcap", f".mcap{PART_SUFFIX}")


class Recording(NamedTuple):
    """A file of the folder."""

    key: str  # identifies it in addresses: a hash of its name, which may be no text
    path: Path
    size_bytes: int
    changed_s: float  # Unix time


class Recordings:
    """Lists recordings and makes reports, one at a time."""

    def __init__(self, folder: Path, reports: Path) -> None:
        """folder: of the recordings; it may be missing. reports: a folder for reports, which others cannot read."""
        self.folder, self._reports = folder, reports
        self._made: OrderedDict[tuple[str, int, float], Path] = OrderedDict()
        self._busy = asyncio.Lock()
        self._count = 0

    def list(self) -> list[Recording]:
        """Return the newest recordings, the newest first."""
        found = []
        with suppress(OSError), os.scandir(self.folder) as entries:
            for entry in entries:
                if entry.name.endswith(_SUFFIXES) and entry.is_file(follow_symlinks=False):
                    with suppress(OSError):  # it may have been deleted meanwhile
                        status = entry.stat(follow_symlinks=False)
                        found.append(Recording(_key(entry.name), Path(entry.path), status.st_size, status.st_mtime))
        return sorted(found, key=lambda recording: recording.changed_s, reverse=True)[:MOST_LISTED]

    def described(self) -> dict[str, Any]:
        """Return the list as a message for the page."""
        return {
            "folder": plain(str(self.folder.absolute())),
            "recordings": [
                {
                    "key": found.key,
                    "name": plain(found.path.name),
                    "size_bytes": found.size_bytes,
                    "changed_s": round(found.changed_s),
                    "state": _state(found.path),
                }
                for found in self.list()
            ],
        }

    async def report(self, key: str) -> Path:
        """Return the HTML page about a recording. Raise OmnidError with the reason where there is none."""
        found = next((recording for recording in self.list() if recording.key == key), None)
        if found is None:
            raise OmnidError("this recording is not there any more: load the list again")
        version = (found.key, found.size_bytes, found.changed_s)
        if self._busy.locked():
            raise OmnidError("another report is being made: try again in a moment")
        async with self._busy:
            if version not in self._made:
                self._made[version] = await self._make(found.path)
            while len(self._made) > MOST_REPORTS:
                self._made.popitem(last=False)[1].unlink(missing_ok=True)
            return self._made[version]

    async def _make(self, log: Path) -> Path:
        self._count += 1
        page = self._reports / f"{self._count}.html"
        process = await asyncio.create_subprocess_exec(
            *python("-m", "omnid", "report", str(log.absolute()), "-o", str(page)),
            env=python_environment(),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
        )
        with suppress(OSError):  # it has ended already
            os.setpriority(os.PRIO_PROCESS, process.pid, NICE)
        try:
            async with asyncio.timeout(REPORT_S):
                _, errors = await process.communicate()
        except TimeoutError:
            raise OmnidError(f"the report is not ready within {REPORT_S:g} s: make it by omnid report") from None
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        if process.returncode != 0 or not page.is_file():
            raise OmnidError(_reason(process.returncode, errors.decode("utf-8", "replace"), log.name))
        return page


def _reason(code: int | None, messages: str, name: str) -> str:
    """Return why there is no report: the program's own line, never the traceback of a program that failed otherwise."""
    lines = messages.splitlines()
    if code == _WRONG_INPUT and lines:
        return one_line(lines[-1])
    return f"omnid: the report about {plain(name)} failed (exit code {code}): run `omnid report` on it to see why"


def _key(name: str) -> str:
    return hashlib.sha256(os.fsencode(name)).hexdigest()[:24]


def _state(path: Path) -> str:
    """Return the state of a recording by its two ends, as a list of many must be quick."""
    if is_locked(path):
        return "being written"
    try:
        with closing(LogFile(path)) as file:
            is_complete = has_footer(file) and not path.name.endswith(PART_SUFFIX)
    except DriverError:
        return "no log"
    return "whole" if is_complete else "cut"


def recordings_routes(recordings: Recordings) -> list[BaseRoute]:
    """Return the addresses."""

    async def list_all(_: Request) -> Response:
        return JSONResponse(await asyncio.to_thread(recordings.described))

    async def report(request: Request) -> Response:
        """POST: make the report, answered when it is ready; GET: show it."""
        try:
            page = await recordings.report(request.path_params["key"])
        except OmnidError as error:
            return JSONResponse({"done": False, "text": str(error)}, 409)
        if request.method == "POST":
            return JSONResponse({"done": True, "text": ""})
        return FileResponse(page, media_type="text/html", headers={"Content-Security-Policy": REPORT_POLICY})

    return [Route("/recordings", list_all), Route("/recordings/{key}/report", report, methods=["GET", "POST"])]
