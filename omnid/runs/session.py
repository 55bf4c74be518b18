"""The parts that live runs and replays share: statistics, geometry, bus, controller and encoders."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Final

import cv2

from calib.models.names import sees_directly
from calib.rig import Rig
from calib.rig_file import parse_rig, rig_toml
from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from omnid.config import Config
from omnid.controller.ipc import ControllerStart
from omnid.controller.link import ControllerLink
from omnid.diagnostics.run_summary import RunStatistics
from omnid.engine.graph import Graph
from omnid.engine.robot_clock import RobotClock, log_time
from omnid.engine.telemetry import StageStats
from omnid.engine.threads import Poller, started
from omnid.errors import OmnidError
from omnid.runs.files import RunPlaces
from omnid.settings import dump
from omnid.sinks.encoder import Encoder, UnixTime
from omnid.stages.geometry import Geometry, geometry, with_rims
from omnid.transport.bus import Bus
from omnid.transport.status_names import BUS, Stats

BUS_S: Final = 3.0  # Time until a bus must be closed.
CLOUD_POINTS: Final = 50_000  # Most points of the map in one message.


def attached_rig(reader: LogReader, log: object) -> Rig:
    """Return the rig of the rig.toml that is attached to the log; OmnidError if there is none."""
    attached = reader.attachments().get("rig.toml")
    if attached is None:
        raise OmnidError(
            f"{log}: no rig.toml is attached to the log; give one with --rig, made by `omnid calibrate "
            "import camchain.yaml -o rig.toml`"
        )
    return parse_rig(attached, None, f"{log}: attached rig.toml")


def run_to_end(graph: Graph, run_places: RunPlaces) -> None:
    """Run until the end, then complete the map of places, also after a failure, which is the error that is raised."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the stages are threads themselves
    try:
        graph.run()
    except BaseException:
        with suppress(OmnidError):
            run_places.finish_run()
        raise
    finally:
        cv2.setNumThreads(threads)
    run_places.finish_run()


class Session:
    """One run: its graph, its statistics and its outputs, which are closed in reverse order when `outputs` closes."""

    def __init__(
        self,
        config: Config,
        graph: Graph,
        outputs: ExitStack,
        warn: Callable[[str], None],
        clock: RobotClock | None = None,
    ) -> None:
        """warn: takes a line for the user; clock: that of the stamps of the frames, None: they are Unix time."""
        self.config, self.graph, self.outputs, self.warn = config, graph, outputs, warn
        self.clock, self.statistics = clock or log_time(), RunStatistics(clock)
        self.parts: dict[str, Callable[[], Stats]] = {}  # numbers of the parts of a live run, by their names

    def geometry(self, rig: Rig, frames: Iterable[Frame]) -> Geometry:
        """Return the geometry of the rig; its missing masks are looked for in frames of a log."""
        rig = with_rims(rig, frames)
        for name, camera in (("lower", rig.lower), ("upper", rig.upper)):
            if camera.mask is None and not sees_directly(camera.camera):
                self.warn(
                    f"no mirror rim is known of the {name} camera: the largest disc is used; give it in the rig's file "
                    f"under [{name}.mask], by `omnid calibrate drive --only mask`"
                )
        return geometry(rig, self.config.panorama)

    def every(self, period_s: float, action: Callable[[], object], name: str) -> None:
        """Call an action each period, in a thread of its own, until the outputs are closed."""
        self.outputs.callback(Poller(action, period_s, name).close)

    def open_bus(self, rig: Rig, *, gives_time: bool) -> Bus:
        """Open the bus; it answers queries for the configuration and the rig. gives_time: as Bus has it."""
        bus = Bus(self.config.bus, self.warn, gives_time=gives_time)

        def close() -> None:
            closing = started(bus.close, "bus-close")
            closing.join(BUS_S)  # zenoh waits for subscribers that do not read, for 10 s; a service has less time
            if closing.is_alive():
                self.warn(f"the bus has not closed within {BUS_S:g} s: a subscriber does not read")

        self.outputs.callback(close)
        self.parts[BUS] = bus.stats
        bus.serve("config", dump(self.config))
        bus.serve("rig", rig_toml(rig))
        return bus

    def start_controller(self, *, of_replay: bool = False) -> ControllerLink:
        """Start the controller process; DriverError where its settings cannot be used.

        A live run waits for its motor controller as for its cameras, while a replay needs it at once: DriverError. The
        process of a replay has no privileges. The wheels stop, and the process ends, at the latest with `outputs`.
        """
        settings, realtime = self.config.controller, self.config.realtime
        if of_replay:
            settings, realtime = settings.of_replay, replace(realtime, lock_memory=False, motor_priority=0)
        elif not self.config.obstacles.enabled:
            settings = settings.without_obstacles
        start = ControllerStart(self.config.motor, settings, realtime, waits=of_replay)
        link = ControllerLink(start, self.graph.telemetry.add(StageStats("motor", is_ticker=True)), self.warn)
        self.outputs.callback(link.close)
        return link

    def encoder(self, rig: Rig, unix_ns: UnixTime | None = None) -> Encoder:
        """Return the encoder of the messages that leave the run; unix_ns: None for that of the clock."""
        scan_range_m = self.config.obstacles.scan.max_range_m
        return Encoder(rig.T_base_rig, CLOUD_POINTS, unix_ns or self.clock.unix_ns, rig, scan_range_m)
