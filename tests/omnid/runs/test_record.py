"""A run that only records."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from drivers.frame import Frame
from drivers.logs.log_reader import LogReader
from omnid.config import Config
from omnid.engine.graph import NEWEST, Graph
from omnid.runs.record import open_recorder, record
from omnid.transport.codec import ERROR, OK
from omnid.transport.status_names import RECORDING, entry
from tests.omnid.sinks.test_recorder import frame, times

START_NS = 1_700_000_000 * 10**9


def settings(folder: Path, **more: Any) -> Config:
    config = Config()
    return replace(config, record=replace(config.record, folder=str(folder), free_mb=0, file_mb=1, **more))


def recorded(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))


class Given:
    """A source of given frames."""

    def __init__(self, frames: list[Frame]) -> None:
        self._frames = frames
        self.frames = lambda: iter(self._frames)

    def close(self) -> None:
        """Nothing to close."""


def test_a_blocked_disk_stops_no_camera(tmp_path: Path) -> None:
    recorder = open_recorder(settings(tmp_path / "log"), "", lambda *_: None, time=times())
    graph, seen_s, until_s = Graph(policy=NEWEST, depth=3), list[float](), time.monotonic() + 0.5

    def late(message: Frame) -> None:
        time.sleep(max(0.0, until_s - time.monotonic()))
        recorder.process(message)

    stream = graph.source("lower", lambda: iter([frame(n, "lower") for n in range(50)]))
    graph.sink("record", late, stream)
    graph.sink("odometry", lambda _: seen_s.append(time.monotonic()), stream)
    graph.run()
    recorder.close()
    stats = graph.telemetry.of("record")
    assert stats.dropped >= 40 and stats.dropped + recorder.state.messages == 50
    assert min(seen_s) < until_s  # the others went on meanwhile


def test_reports_the_state_of_the_recording(tmp_path: Path) -> None:
    config = settings(tmp_path / "log")
    recorder = open_recorder(config, "", lambda *_: None, time=times())
    assert (entry(RECORDING, recorder.stats()).level, entry(RECORDING, recorder.stats()).message) == (OK, "waiting")
    recorder.process(frame(0, "lower"))
    status = entry(RECORDING, recorder.stats())
    assert status.message == "recording" and status.values["messages"] == "1" and Path(status.values["file"]).exists()
    recorder.close()
    full = replace(config, record=replace(config.record, free_mb=1_000_000))
    recorder = open_recorder(full, "", lambda *_: None, time=times())
    recorder.process(frame(0, "lower"))
    status = entry(RECORDING, recorder.stats())
    assert status.level == ERROR and status.values["lost"] == "1" and "1000001 needed" in status.message


def test_records_both_cameras_and_reports_the_result(tmp_path: Path) -> None:
    events: list[tuple[int, str]] = []
    now_ns = time.monotonic_ns()
    sources = {
        camera: Given([replace(frame(n, camera), stamp_ns=now_ns + n) for n in range(10)])
        for camera in ("lower", "upper")
    }
    before = signal.getsignal(signal.SIGTERM)
    state = record(
        sources,
        settings(tmp_path / "log"),
        "version = 1",  # type: ignore[arg-type]
        lambda severity, text: events.append((severity, text)),
    ).state
    assert signal.getsignal(signal.SIGTERM) is before
    assert (state.messages, state.lost, state.status) == (20, 0, "closed")
    assert "20 messages in 1 files" in events[-1][1]
    (path,) = recorded(tmp_path / "log")
    reader = LogReader(path)
    frames = list(reader.frames())
    assert len(frames) == 20 and abs(frames[0].stamp_ns - time.time_ns()) < 60 * 10**9
    assert "rig.toml" in reader.attachments()
