"""Targets of the viewer: a file, a window, or a browser of this machine; nothing is served to other machines."""

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

from omnid.engine.process import handle_stop_signals, python, python_environment
from omnid.errors import OmnidError

ALTERNATIVES: Final = "write a file with -o FILE.rrd, or serve a browser of this machine with --web"
APPLICATION: Final = "omnid"
LOCALHOST: Final = "127.0.0.1"
MEMORY_LIMIT: Final = "2GB"  # Memory of the viewer; it forgets the oldest data.
TIMEOUT_S: Final = 30.0
FLUSH_PERIOD_S: Final = 10.0
MIN_FREE_BYTES: Final = 64 << 20  # Least free space on the disk.
_POLL_S: Final = 0.05
_MAX_LOG_BYTES: Final = 2**14  # Bytes of the viewer's output that are read, to report its last line.


class ClosedError(OmnidError):
    """The user has closed the viewer."""


class ViewerTarget(Protocol):
    """Destination of a scene: started once, finished once."""

    def start(self, layout: Any) -> rr.RecordingStream:
        """Open the destination with a blueprint and return its stream. Raise OmnidError where that fails."""

    def flush(self) -> None:
        """Wait until everything drawn has arrived. Raise OmnidError where it cannot."""

    @property
    def closed(self) -> bool:
        """True if the user has closed the viewer."""

    def finish(self) -> str:
        """End it once everything is drawn. Return a line for the user that states where it is."""

    def abandon(self) -> None:
        """End it after an error, so that no process is left running."""


class RrdFile:
    """An .rrd file, to be opened with `rerun`."""

    closed = False

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stream: rr.RecordingStream | None = None
        if path.exists() and not path.is_file():
            raise OmnidError(f"-o {path}: expected a regular file, found a device or a pipe")

    def start(self, layout: Any) -> rr.RecordingStream:
        """Open the file."""
        self._require_room()
        batches = rr.ChunkBatcherConfig.DEFAULT()
        batches.flush_tick = timedelta(seconds=FLUSH_PERIOD_S)  # fewer pieces make a smaller file
        stream = rr.RecordingStream(APPLICATION, batcher_config=batches)
        try:
            stream.save(self._path, layout)
        except (OSError, RuntimeError) as error:
            raise OmnidError(f"-o {self._path}: cannot be written: {error}; name another file") from error
        self._stream = stream
        return stream

    def flush(self) -> None:
        """Write everything."""
        self._require_room()
        if self._stream is not None:
            _flush(self._stream, f"-o {self._path}: cannot be written")

    def _require_room(self) -> None:
        """Raise OmnidError where the disk is nearly full: rerun 0.41 blocks for ever on a full one, at exit, too."""
        free = shutil.disk_usage(self._path.resolve().parent).free
        if free < MIN_FREE_BYTES:
            raise OmnidError(
                f"-o {self._path}: the disk has {free >> 20} MB left, expected {MIN_FREE_BYTES >> 20} MB "
                "or more: free some space, or name a file on another disk"
            )

    def finish(self) -> str:
        """Return how to open the file."""
        return f"{self._path}: open it with `rerun {self._path}`, here or on another machine"

    def abandon(self) -> None:
        """Keep what has been written."""


class Viewer:
    """rerun's viewer in a process of its own; a window outlives this program, the server for a browser does not."""

    def __init__(self, web: bool, port: int) -> None:
        """web: serve a browser, at a port of this machine and the next one; port 0: any two that are free."""
        self._web, self._port = web, port
        self._process: subprocess.Popen[bytes] | None = None
        self._stream: rr.RecordingStream | None = None
        self._output: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the viewer
        if not web:
            _require_display()

    def start(self, layout: Any) -> rr.RecordingStream:
        """Start the viewer and wait until it accepts connections."""
        opt_out()
        web_port, port = self._ports()
        url = f"rerun+http://{LOCALHOST}:{port}/proxy"
        served = ["--serve-web", "--web-viewer-port", str(web_port)] if self._web else ["--expect-data-soon"]
        self._process = _started(
            self._output,
            [
                "--bind",
                LOCALHOST,
                "--port",
                str(port),
                "--hide-welcome-screen",
                "--memory-limit",
                MEMORY_LIMIT,
                "--server-memory-limit",
                MEMORY_LIMIT,
                *served,
            ],
        )
        _wait_for(port, self._process, self._output)
        stream = rr.RecordingStream(APPLICATION)
        stream.connect_grpc(url, default_blueprint=layout)
        self._stream = stream
        if self._web:
            page = f"http://{LOCALHOST}:{web_port}/?url={quote(url, safe='')}"
            forwarded = f"-L {web_port}:{LOCALHOST}:{web_port} -L {port}:{LOCALHOST}:{port}"
            print(
                f"omnid: open {page} on this machine; on another one after: ssh {forwarded} {socket.gethostname()}",
                file=sys.stderr,
                flush=True,
            )
        return stream

    def _ports(self) -> tuple[int, int]:
        """Return the ports of the page and of its data. Raise OmnidError where one that is named is taken."""
        if not self._port:
            return _free_port(), _free_port()
        for port in (self._port, self._port + 1):
            if _accepts_connections(port):
                raise OmnidError(
                    f"--port {self._port}: another program listens on {port}; it needs that port and the "
                    "next one: stop the other program, or name another port"
                )
        return self._port, self._port + 1

    def flush(self) -> None:
        """Wait until everything has arrived."""
        if self._stream is not None:
            self._require_viewer()
            _flush(self._stream, "rerun's viewer does not accept data any more")

    @property
    def closed(self) -> bool:
        """True if the viewer has ended."""
        return self._process is not None and self._process.poll() is not None

    def finish(self) -> str:
        """Leave a window open; serve a browser until Ctrl-C."""
        if not self._web or self._process is None:
            return "the window stays open until it is closed"
        with handle_stop_signals(lambda *_: self.abandon()):
            print("omnid: complete; Ctrl-C ends the server", file=sys.stderr, flush=True)
            self._process.wait()
        return "no longer served"

    def _require_viewer(self) -> None:
        """Raise ClosedError where it was closed, OmnidError where it failed, as some do later without a screen."""
        if self._process is not None and self.closed:
            if self._process.returncode:
                raise OmnidError(f"rerun's viewer has failed ({_last_line(self._output)}): {ALTERNATIVES}")
            raise ClosedError("rerun's viewer was closed")

    def abandon(self) -> None:
        """End the server for a browser; leave a window open."""
        if self._web and self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGTERM)


def _flush(stream: rr.RecordingStream, fault: str) -> None:
    try:
        stream.flush(timeout_sec=TIMEOUT_S)
    except RuntimeError as error:
        raise OmnidError(f"{fault}: {error}") from error


def opt_out() -> None:
    """Turn rerun's usage statistics off for this user; `rerun analytics enable` turns them on again."""
    with suppress(OSError, subprocess.SubprocessError):
        subprocess.run(
            _rerun(["analytics", "disable"]),
            capture_output=True,
            timeout=TIMEOUT_S,
            check=False,
            env=python_environment(),
        )


def _require_display() -> None:
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise OmnidError(f"there is no display to open a window on: {ALTERNATIVES}")


def _rerun(arguments: list[str]) -> list[str]:
    """Return the command line of rerun's viewer; `python -m rerun_cli` does not return its exit code."""
    return python("-c", "import sys; from rerun_cli.__main__ import main; sys.exit(main())", *arguments)


def _started(output: IO[bytes], arguments: list[str]) -> subprocess.Popen[bytes]:
    """Start the viewer in a session of its own, which Ctrl-C does not end."""
    return subprocess.Popen(
        _rerun(arguments),
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        start_new_session=True,
        env=python_environment(RUST_LOG="warn"),
    )


def _wait_for(port: int, process: subprocess.Popen[bytes], output: IO[bytes]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not _accepts_connections(port):
        if process.poll() is not None or time.monotonic() > deadline_s:
            raise OmnidError(f"rerun's viewer does not start ({_last_line(output)}): {ALTERNATIVES}")
        time.sleep(_POLL_S)


def _accepts_connections(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((LOCALHOST, port)) == 0


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])


def _last_line(output: IO[bytes]) -> str:
    output.seek(max(0, output.seek(0, os.SEEK_END) - _MAX_LOG_BYTES))
    lines = output.read().decode("utf-8", "replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "no output")
