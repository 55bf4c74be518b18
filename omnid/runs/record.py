"""A run that only records: two cameras, a folder, until a signal ends it."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

from drivers.frame import Camera, FrameSource
from drivers.logs.rotating_log import RotatingLog
from omnid.config import Config
from omnid.engine.graph import Graph
from omnid.engine.logging_setup import Report
from omnid.engine.robot_clock import RobotClock
from omnid.runs.wiring import RECORDED_DEPTH
from omnid.settings import dump
from omnid.sinks.encoder import Encoder
from omnid.sinks.recorder import Recorder


def open_recorder(
    config: Config, rig: str, report: Report, clock: RobotClock, encode: Encoder | None = None
) -> Recorder:
    """Return a recorder to the folder of the configuration; the first message makes the first file.

    rig: the rig's TOML, or "" where there is none; it is attached to every file, as is the configuration.
    report: takes severity and text of problems. clock: see Recorder. encode: of the other messages of a run, whose
    images are thinned to record.images_hz; None: all images and nothing else are recorded.
    """
    attachments = {"omnid.toml": dump(config).encode()} | ({"rig.toml": rig.encode()} if rig else {})
    folder = Path(config.record.folder)
    log = RotatingLog(folder, config.bus.robot, config.record.rotation(), attachments, on_event=report)
    images_hz = config.record.images_hz if encode is not None else 0.0
    return Recorder(log, config.bus.robot, encode, clock=clock, skip_invalid=True, images_hz=images_hz)


def record(sources: Mapping[Camera, FrameSource], config: Config, rig: str, report: Report) -> Recorder:
    """Record frames with stamps of CLOCK_MONOTONIC until the sources end or a signal comes; return the recorder."""
    clock = RobotClock(report=lambda line: report(logging.WARNING, line))
    graph = Graph(drops=True, depth=RECORDED_DEPTH)
    frames = [graph.source(name, source.frames, wake=source.close) for name, source in sources.items()]
    recorder = open_recorder(config, rig, report, clock)
    graph.sink("record", recorder, *frames)

    with closing(recorder), graph.signals():
        graph.run()
    state, dropped = recorder.state, graph.telemetry.of("record").dropped
    written = state.messages - state.lost
    report(
        logging.INFO if written else logging.WARNING,
        f"recorded {written} messages in {state.files} files, lost {state.lost}, dropped {dropped}, "
        f"refused {recorder.invalid}, oldest files deleted {state.deleted}, {state.status}",
    )
    return recorder
