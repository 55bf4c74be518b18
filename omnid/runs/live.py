"""A run on the robot: two cameras, the stages, the wheels, the bus, until a signal ends it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from functools import partial
from importlib import import_module
from pathlib import Path

import cv2

from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.frame import CAMERAS
from omnid.config import Config
from omnid.engine.graph import LOSSLESS, NEWEST, Graph
from omnid.engine.kernel_cache import prepare_kernels, read_kept_kernels
from omnid.engine.logging_setup import Report
from omnid.engine.realtime import ThreadStart, give_back_code, name_thread, prepare, priorities
from omnid.engine.threads import started
from omnid.errors import OmnidError
from omnid.runs.live_robot import LiveRobot
from omnid.runs.session import OPENCV_THREADS, Session
from omnid.runs.systemd import print_stacks_when_killed
from omnid.stages.geometry import Geometry


class LiveRun:
    """One run of the daemon."""

    def __init__(
        self,
        config: Config,
        robot: LiveRobot,
        report: Report,
        rig: Rig | None = None,
        show: Callable[[str], None] | None = None,
    ) -> None:
        """rig: None for that of the configuration. show: rewrites a line of the terminal; None without a terminal."""
        self._config, self._robot, self._report, self._rig, self._show = config, robot, report, rig, show
        self._graph = _graph_that_waits() if robot.waits else _graph_in_time(config, report)
        self._connected = False

    def run(self) -> int:
        """Run until a signal comes, or the cameras end; return the exit code."""
        print_stacks_when_killed()
        loaded = started(_load, "imports")
        offset_ns = time.time_ns() - self._robot.clock_ns()
        with ExitStack() as outputs:
            session = Session(
                self._config,
                self._graph,
                outputs,
                lambda text: self._report(logging.WARNING, text),
                offset_ns=offset_ns,
                clock_ns=self._robot.clock_ns,
            )
            outputs.enter_context(session.signals(self._on_signal))
            geometry = self._geometry(session)
            loaded()
            from omnid.runs.live_wiring import LiveWiring
            from omnid.runs.place_maps import RunPlaces

            prepare_kernels()
            give_back_code("llvmlite")  # which has loaded the compiled functions, and does nothing else in a run
            self._connected = True
            run_places = RunPlaces(self._config, geometry, session.warn)
            LiveWiring(session, geometry, self._robot, self._report).wire(run_places)
            if self._show is not None:
                from omnid.runs.live_status import add_terminal_ticker

                add_terminal_ticker(session, self._show, self._report, self._robot.words)
            cv2.setNumThreads(OPENCV_THREADS)
            if not self._robot.waits:
                for refused in prepare(self._config.realtime):
                    session.warn(refused)
            started(_import_rarely_used, "imports")
            try:
                self._graph.run()
            except BaseException:
                with suppress(OmnidError):  # the error that ended the run is the one that is reported
                    run_places.finish()
                raise
            run_places.finish()
        return 0

    def _on_signal(self, number: int, again: bool) -> None:
        """End the program at once while the first images are awaited.

        Later the session has stopped the graph, which ends the run as soon as it begins: an exception while
        connections are opened would leave threads behind that keep Python from ending.
        """
        if not self._connected:
            raise SystemExit(0)

    def _geometry(self, session: Session) -> Geometry:
        rig = self._rig or read_rig(Path(self._config.cameras.rig))
        with closing(self._robot.first_frames()) as frames:
            return session.geometry(rig, frames)


def _graph_in_time(config: Config, report: Report) -> Graph:
    """Return a graph whose stages take the newest messages, in threads with the priorities of the settings."""
    return Graph(policy=NEWEST, depth=1, on_thread=ThreadStart(priorities(config.realtime, *CAMERAS), report))


def _graph_that_waits() -> Graph:
    """Return a graph that drops nothing, in threads as others are: the robot's time waits for it."""
    return Graph(policy=LOSSLESS, sinks_wait=True, on_thread=name_thread)


def _load() -> None:
    """Load what the stages need while images are awaited; what fails is loaded, and reported, where it is used."""
    for load in (partial(import_module, "omnid.runs.live_wiring"), _compile_serialisers, read_kept_kernels):
        with suppress(Exception):
            load()


def _compile_serialisers() -> None:
    from omnid.transport.codec import compile_serialisers
    from omnid.transport.navigation_codec import PATH_SCHEMA, STRING_SCHEMA

    compile_serialisers(PATH_SCHEMA, STRING_SCHEMA)


def _import_rarely_used() -> None:
    """Import what the first loop and the first goal need while the first poses are computed."""
    with suppress(Exception):
        for name in ("scipy.sparse.linalg", "scipy.spatial"):
            import_module(name)
