"""From what is to be shown to where it is shown."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

from drivers.logs.mcap_info import LogInfo, read_log_info
from omnid.config import Config
from omnid.errors import OmnidError
from omnid.runs.replay import ReplayOptions, Topics
from omnid.sinks.files import check_outputs
from omnid.transport.bus_config import BusConfig
from omnid.viewer.layout import layout
from omnid.viewer.live_robot import LiveRobotView
from omnid.viewer.recorded_run import RecordedRunView, poses_topic
from omnid.viewer.replayed_run import MAP_EVERY_S, ReplayedRunView
from omnid.viewer.rerun_scene import RerunScene
from omnid.viewer.targets import ClosedError, RrdFile, Viewer, ViewerTarget

PANORAMA: Final = "Panorama"
Replay: TypeAlias = Callable[[Path, Config, ReplayOptions], int]  # runs a log and returns the exit code


@dataclass(frozen=True, slots=True)
class Log:
    """A log, and how to look at it."""

    path: Path
    robot: str | None = None
    replay: bool = False  # from its images, though it has poses
    rig: Path | None = None
    topics: Topics = (None, None)
    settings: Path | None = None  # file of the configuration


def place_for(out: Path | None, web: bool) -> ViewerTarget:
    """The file that is named, else a viewer."""
    return RrdFile(out) if out is not None else Viewer(web)


def check_file(out: Path | None, *read: tuple[str, Path | None]) -> None:
    """OmnidError where the file cannot be written, or is one of those (what, path) that are read."""
    if out is not None:
        check_outputs([("-o", out)], [(what, path) for what, path in read if path is not None])


def show_log(log: Log, config: Config, place: ViewerTarget, replay: Replay) -> int:
    """Shows a log: the poses that are recorded in it, else what can be computed from its images; the exit code."""
    found = read_log_info(log.path)
    topic = None if log.replay else poses_topic(found, log.robot)
    image = PANORAMA if topic is None else _title(RecordedRunView.images(found, topic))
    board = RerunScene(place, layout(image, depth=topic is None), _most_messages(found, topic))
    code = 0
    with _closing(board, place):
        code = _recorded(found, topic, board) if topic else _computed(log, config, board, replay)
    return _ended(board, place, code)


def show_robot(bus: BusConfig, seconds: float | None, place: ViewerTarget) -> int:
    """Shows a robot; the exit code, 1 where not one pose came."""
    board = RerunScene(place, layout(PANORAMA, depth=False))
    with _closing(board, place):
        LiveRobotView(board).follow(bus, place, seconds)
    return _ended(board, place, int(not board.poses))


def _title(topic: str) -> str:
    """Of the images of a topic."""
    return "" if not topic else PANORAMA if topic.endswith("panorama") else "Lower camera"


@contextmanager
def _closing(board: RerunScene, place: ViewerTarget) -> Iterator[None]:
    """Has all arrive that was drawn, whatever ends it; that somebody closes the window is an end like others."""
    try:
        yield
        board.close()
    except ClosedError as closed:
        print(f"omnid: {closed}", file=sys.stderr)
    except BaseException:
        place.abandon()
        raise
    finally:
        with suppress(OmnidError):  # it was told already, or is not what ended it
            board.close()


def _computed(log: Log, config: Config, board: RerunScene, replay: Replay) -> int:
    options = ReplayOptions(rig=log.rig, topics=log.topics, settings=log.settings, map_every_s=MAP_EVERY_S,
                            observer=lambda place, telemetry: ReplayedRunView(board, place, telemetry))
    return replay(log.path, config, options)


def _recorded(found: LogInfo, topic: str, board: RerunScene) -> int:
    recorded = RecordedRunView(found, topic, board)
    recorded.show()
    if recorded.broken or recorded.damaged:
        print(f"omnid: warning: {found.path}: {recorded.broken} messages and {recorded.damaged} pieces of the file "
              "cannot be read and are left out", file=sys.stderr)
    if not board.poses:
        raise OmnidError(f"{found.path}: topic {topic!r} has no message that is a pose: is the recording cut?")
    return 0


def _most_messages(found: LogInfo, topic: str | None) -> int:
    """How many poses there will be at the most."""
    if topic is not None:
        return found.topics[topic][1]
    return max((count for kind, count in found.topics.values() if kind.startswith("sensor_msgs/msg/")), default=0)


def _ended(board: RerunScene, place: ViewerTarget, code: int) -> int:
    if board.poses:
        of_all = f" of {board.offered}" if board.offered > board.poses else ""
        print(f"{board.poses} poses{of_all} and {board.images} images shown")
    if board.poses and not place.closed:
        print(place.leave(), flush=True)
    return code
