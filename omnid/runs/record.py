"""A run that records and does nothing else: two cameras, a folder, until it is told to end."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

from drivers.events import NOTICE, WARNING, EventCallback
from drivers.frame import Camera, FrameSource
from drivers.logs.log_folder import LogFolder
from drivers.logs.rotating_log import RotatingLog
from omnid.config import Config
from omnid.engine.graph import NEWEST, Graph
from omnid.engine.signals import ended_by_signals
from omnid.settings import dump
from omnid.sinks.encoder import Encoder
from omnid.sinks.frame_recorder import FrameRecorder

PERIOD_S = 15.0  # between two lines about how it goes


def open_recorder(
    config: Config, rig: str, report: EventCallback, *, encode: Encoder | None = None, offset_ns: int = 0
) -> FrameRecorder:
    """The recorder that the settings describe; every file has them attached, and the rig's TOML where there is one.

    No file is made before the first message. offset_ns, encode: as FrameRecorder has them.
    """
    attachments = {"omnid.toml": dump(config).encode()} | ({"rig.toml": rig.encode()} if rig else {})
    folder = LogFolder(Path(config.record.folder), config.bus.robot)
    log = RotatingLog(folder, config.record.rotation(), attachments, on_event=report)
    return FrameRecorder(log, config.bus.robot, encode, offset_ns=offset_ns)


def record(sources: Mapping[Camera, FrameSource], config: Config, rig: str, report: EventCallback) -> FrameRecorder:
    """Records until the sources end or a signal comes; their stamps are CLOCK_MONOTONIC. Gives what became of it."""
    offset_ns = time.time_ns() - time.monotonic_ns()
    recorder = open_recorder(config, rig, report, offset_ns=offset_ns)
    graph = Graph(policy=NEWEST, depth=config.record.queue)
    frames = [graph.source(name, source.frames, wake=source.close) for name, source in sources.items()]
    graph.sink("record", recorder, *frames)
    graph.ticker("progress", PERIOD_S, lambda: report(NOTICE, told(recorder, graph)) if recorder.state.files else None)
    try:
        with ended_by_signals(lambda *_: graph.stop()):  # a second one ends it at once
            graph.run()
    finally:
        recorder.close()
    report(NOTICE if recorder.state.messages else WARNING, told(recorder, graph))
    return recorder


def told(recorder: FrameRecorder, graph: Graph) -> str:
    """How the recording goes, on one line."""
    state = recorder.state
    dropped = sum(stage.dropped for stage in graph.telemetry.stages if stage.name == "record")
    kept = state.messages - state.lost - state.refused
    return (f"recording: {kept} messages in {state.files} files, lost {state.lost}, dropped {dropped}, "
            f"refused {state.refused + recorder.unfit}, oldest files deleted {state.deleted}, {state.status}")
