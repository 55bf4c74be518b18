"""Where the board stands: a file, a window, or a browser of this machine; nothing listens to other machines."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import IO, Any, Final, Protocol
from urllib.parse import quote

import rerun as rr

from omnid.engine.signals import handle_stop_signals
from omnid.errors import OmnidError

INSTEAD: Final = "write a file with -o FILE.rrd, or serve a browser of this machine with --web"
NAME: Final = "omnid"
HERE: Final = "127.0.0.1"
LIMIT: Final = "2GB"  # of the viewer's memory; it forgets the oldest
STARTS_S: Final = 30.0
TICK_S: Final = 10.0
SPARE_BYTES: Final = 64 << 20  # on a disk
_PATIENCE_S: Final = 0.05
_WHOLE_LOG: Final = 2**14  # bytes of what the viewer says that are looked at


class ClosedError(OmnidError):
    """Whoever looked has closed the viewer."""


class ViewerTarget(Protocol):
    """Where a board stands: started once, left once."""

    def start(self, layout: Any) -> rr.RecordingStream:
        """What the board draws on, with what lies where in it; OmnidError where there is none to be had."""

    def keep(self) -> None:
        """Waits until all that is drawn has arrived, so that little is in hand; OmnidError where it cannot."""

    @property
    def closed(self) -> bool:
        """Whether nobody looks any more."""

    def leave(self) -> str:
        """Ends it, once everything is drawn; a line that tells where to find it."""

    def abandon(self) -> None:
        """Ends it after an error, so that nothing is left running."""


class RrdFile:
    """A file that `rerun` opens."""

    closed = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stream: rr.RecordingStream | None = None
        if path.exists() and not path.is_file():
            raise OmnidError(f"-o {path}: expected a file that can be written anew, found a device or a pipe")

    def start(self, layout: Any) -> rr.RecordingStream:
        """Opens the file."""
        self._require_room()
        batches = rr.ChunkBatcherConfig.DEFAULT()
        batches.flush_tick = timedelta(seconds=TICK_S)  # nobody waits for it, and fewer pieces make a smaller file
        stream = rr.RecordingStream(NAME, batcher_config=batches)
        try:
            stream.save(self._path, layout)
        except (OSError, RuntimeError) as error:
            raise OmnidError(f"-o {self._path}: cannot be written: {error}; name another file") from error
        self._stream = stream
        return stream

    def keep(self) -> None:
        """Has everything written."""
        self._require_room()
        if self._stream is not None:
            _flush(self._stream, f"-o {self._path}: cannot be written any more")

    def _require_room(self) -> None:
        """OmnidError where the disk is nearly full: on one that is, rerun 0.41 waits for ever and not even ends."""
        free = shutil.disk_usage(self._path.resolve().parent).free
        if free < SPARE_BYTES:
            raise OmnidError(f"-o {self._path}: the disk has {free >> 20} MB left, expected {SPARE_BYTES >> 20} MB to "
                             "spare: make room, or name a file on another one")

    def leave(self) -> str:
        """Where the file is."""
        return f"{self._path}: look at it with `rerun {self._path}`, here or on another machine"

    def abandon(self) -> None:
        """What has been written stays."""


class Viewer:
    """rerun's own viewer in a process of its own; a window outlives us, the server of a browser's does not."""

    def __init__(self, web: bool) -> None:
        self._web = web
        self._process: subprocess.Popen[bytes] | None = None
        self._stream: rr.RecordingStream | None = None
        self._said: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the viewer
        if not web:
            _require_display()

    def start(self, layout: Any) -> rr.RecordingStream:
        """Starts the viewer and waits until it listens."""
        opt_out()
        port, web_port = _free_port(), _free_port()
        url = f"rerun+http://{HERE}:{port}/proxy"
        served = ["--serve-web", "--web-viewer-port", str(web_port)] if self._web else ["--expect-data-soon"]
        self._process = _started(self._said, ["--bind", HERE, "--port", str(port), "--memory-limit", LIMIT,
                                              "--server-memory-limit", LIMIT, "--hide-welcome-screen", *served])
        _wait_for(port, self._process, self._said)
        stream = rr.RecordingStream(NAME)
        stream.connect_grpc(url, default_blueprint=layout)
        self._stream = stream
        if self._web:
            page = f"http://{HERE}:{web_port}/?url={quote(url, safe='')}"
            print(f"omnid: look at {page} on this machine", file=sys.stderr, flush=True)
        return stream

    def keep(self) -> None:
        """Has everything arrive."""
        if self._stream is not None:
            self._require_viewer()
            _flush(self._stream, "rerun's viewer takes nothing any more")

    @property
    def closed(self) -> bool:
        """Whether the viewer has ended."""
        return self._process is not None and self._process.poll() is not None

    def leave(self) -> str:
        """A window stays; what a browser looks at is served until Ctrl-C."""
        if not self._web or self._process is None:
            return "the window stays until it is closed"
        with handle_stop_signals(lambda *_: self.abandon()):
            print("omnid: that is all; Ctrl-C ends it", file=sys.stderr, flush=True)
            self._process.wait()
        return "no longer served"

    def _require_viewer(self) -> None:
        """ClosedError where it was closed, OmnidError where it failed: without a screen some do so after a while."""
        if self._process is not None and self.closed:
            if self._process.returncode:
                raise OmnidError(f"rerun's viewer has failed ({_last_line(self._said)}): {INSTEAD}")
            raise ClosedError("rerun's viewer was closed")

    def abandon(self) -> None:
        """Ends what serves a browser; a window stays."""
        if self._web and self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGTERM)


def _flush(stream: rr.RecordingStream, fault: str) -> None:
    try:
        stream.flush(timeout_sec=STARTS_S)
    except RuntimeError as error:
        raise OmnidError(f"{fault}: {error}") from error


def opt_out() -> None:
    """Has rerun send nothing about its use, for this user; `rerun analytics enable` takes it back."""
    with suppress(OSError, subprocess.SubprocessError):
        subprocess.run(_rerun(["analytics", "disable"]), capture_output=True, timeout=STARTS_S, check=False)


def _require_display() -> None:
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise OmnidError(f"there is no display here to open a window on: {INSTEAD}")


def _rerun(words: list[str]) -> list[str]:
    """The program that comes with rerun's package; `python -m rerun_cli` would keep its exit code to itself."""
    return [sys.executable, "-c", "import sys; from rerun_cli.__main__ import main; sys.exit(main())", *words]


def _started(said: IO[bytes], words: list[str]) -> subprocess.Popen[bytes]:
    """The viewer in a session of its own, that no Ctrl-C of ours ends; said: takes what it says."""
    return subprocess.Popen(_rerun(words), stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True,
                            env=os.environ | {"RUST_LOG": "warn"})


def _wait_for(port: int, process: subprocess.Popen[bytes], said: IO[bytes]) -> None:
    deadline_s = time.monotonic() + STARTS_S
    while not _answers(port):
        if process.poll() is not None or time.monotonic() > deadline_s:
            raise OmnidError(f"rerun's viewer does not start ({_last_line(said)}): {INSTEAD}")
        time.sleep(_PATIENCE_S)


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((HERE, port)) == 0


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HERE, 0))
        return int(probe.getsockname()[1])


def _last_line(said: IO[bytes]) -> str:
    said.seek(max(0, said.seek(0, os.SEEK_END) - _WHOLE_LOG))
    lines = said.read().decode("utf-8", "replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")
