"""The parts of runs: warnings at the start, the rig of a log, the first images, the line on a terminal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from itertools import islice
from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.rig_file import rig_toml
from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera, Frame
from drivers.logs.log_reader import LogReader
from omnid.config import load_config
from omnid.diagnostics.run_summary import RunStatistics
from omnid.engine.graph import Graph
from omnid.engine.telemetry import Telemetry
from omnid.errors import OmnidError
from omnid.runs.live import ConnectedRobot
from omnid.runs.session import Session, attached_rig
from omnid.runs.systemd import StatusLine
from omnid.simulation.robot import with_masks
from omnid.transport.status_names import Key
from tests.drivers.logs.mcap_logs import pairs, write_log
from tests.simulation.rigs import make_rig


def warnings_of(size_px: int, *overrides: str) -> list[str]:
    """Return the warnings of a run that drives, with images of that size."""
    lines: list[str] = []
    with ExitStack() as outputs:
        session = Session(load_config(None, list(overrides)), Graph(threaded=False), outputs, lines.append)
        session.geometry(with_masks(make_rig(size=size_px, baseline_m=0.2)), [])
        session.with_obstacles_known(session.config.controller)
    return lines


def test_small_images_are_named_with_what_to_do() -> None:
    (line,) = warnings_of(320)
    assert "87 rows" in line and "384 px" in line and "controller.collision.unknown" in line


@pytest.mark.parametrize(
    ("size_px", "override"),
    [
        (384, "controller.collision.unknown=stop"),
        (320, "controller.collision.unknown=slow"),
        (320, "controller.collision.check=false"),
    ],
)
def test_no_warning_of_images_that_are_large_enough_or_do_not_matter(size_px: int, override: str) -> None:
    assert warnings_of(size_px, override) == []


def test_a_run_without_obstacles_says_that_nothing_keeps_the_base_from_them() -> None:
    (line,) = warnings_of(320, "obstacles.enabled=false")
    assert "the collision monitor is off" in line


def test_the_attached_rig_is_read(tmp_path: Path) -> None:
    rig = make_rig(size=256)
    log = write_log(tmp_path / "a.mcap", pairs(1), [("rig.toml", rig_toml(rig).encode())])
    with closing(LogReader(log)) as reader:
        assert attached_rig(reader, log).baseline_m == pytest.approx(rig.baseline_m)


@pytest.mark.parametrize(
    ("attached", "error", "words"),
    [([], OmnidError, "give one with --rig"), ([("rig.toml", b"x = ")], CalibError, "a.mcap: attached rig.toml: ")],
)
def test_a_log_without_a_rig_says_what_to_do(
    tmp_path: Path, attached: list[tuple[str, bytes]], error: type[Exception], words: str
) -> None:
    log = write_log(tmp_path / "a.mcap", pairs(1), attached)
    with closing(LogReader(log)) as reader, pytest.raises(error, match=words):
        attached_rig(reader, log)


class Images:
    """A camera that never ends, and counts how often it is closed."""

    def __init__(self, camera: Camera) -> None:
        self.camera, self.closed, self.state = camera, 0, CameraState()

    def frames(self) -> Iterator[Frame]:
        seq = 0
        while True:
            yield Frame(seq, seq, self.camera, "mono8", b"\0", 1, 1)
            seq += 1

    def close(self) -> None:
        self.closed += 1


def test_the_first_images_come_in_turn_and_the_cameras_are_closed() -> None:
    opened = list[Images]()

    def open_camera(camera: Camera) -> Images:
        opened.append(Images(camera))
        return opened[-1]

    frames = list(islice(ConnectedRobot(open_camera).first_frames(), 100))
    assert [(frame.camera, frame.seq) for frame in frames[:4]] == [
        ("lower", 0),
        ("upper", 0),
        ("lower", 1),
        ("upper", 1),
    ]
    assert [camera.closed for camera in opened] == [1, 1]
    begun = ConnectedRobot(open_camera).first_frames()
    next(begun)
    begun.close()
    assert [camera.closed for camera in opened] == [1, 1, 1, 1]


def test_the_line_and_the_summary_of_a_run() -> None:
    statistics = RunStatistics()
    line = StatusLine(statistics, Telemetry(), lambda: {Key.REAL_TIME_FACTOR: 0.5})
    assert line() == "waiting for images, 0.0 poses/s, 0 messages dropped, 0 deadlines missed, 0.50 x real time"
    assert line.summary() == "ended: 0 poses, 0.00 m, 0 resets"
    statistics.poses, statistics.length_m, statistics.resets = 4, 12.345, 1
    statistics.states = Counter({"tracking": 3, "lost": 1})
    assert line.summary() == "ended: 4 poses, 12.35 m, 1 resets; tracking 75.0%, lost 25.0%"
