"""From what is to be shown to where it is shown."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.logs.mcap_info import Survey, survey
from omnid.config import Config
from omnid.errors import OmnidError
from omnid.runs.replay import Options, Replay, Topics
from omnid.sinks.files import check_outputs
from omnid.transport.bus_config import BusConfig
from omnid.viewer.layout import layout
from omnid.viewer.live_robot import Live
from omnid.viewer.recorded_run import Recorded, poses_topic
from omnid.viewer.replayed_run import MAP_EVERY_S, Computed
from omnid.viewer.rerun_scene import Board
from omnid.viewer.targets import ClosedError, Place, RrdFile, Viewer

PANORAMA: Final = "Panorama"


@dataclass(frozen=True, slots=True)
class Log:
    """A log, and how to look at it."""

    path: Path
    robot: str | None = None
    replay: bool = False  # from its pictures, though it has poses
    rig: Path | None = None
    topics: Topics = (None, None)
    quiet: bool = False


def place_for(out: Path | None, web: bool) -> Place:
    """The file that is named, else a viewer."""
    return RrdFile(out) if out is not None else Viewer(web)


def check_file(out: Path | None, *read: tuple[str, Path | None]) -> None:
    """OmnidError where the file cannot be written, or is one of those (what, path) that are read."""
    if out is not None:
        check_outputs([("-o", out)], [(what, path) for what, path in read if path is not None])


def show_log(log: Log, config: Config, settings: Path | None, place: Place) -> int:
    """Shows a log: the poses that are recorded in it, else what can be computed from its pictures; the exit code."""
    found = survey(log.path)
    topic = None if log.replay else poses_topic(found, log.robot)
    picture = PANORAMA if topic is None else _title(Recorded.pictures(found, topic))
    board = Board(place, layout(picture, depth=topic is None), _most_messages(found, topic))
    code = 0
    with _closing(board, place):
        code = _recorded(found, topic, board) if topic else _computed(log, config, settings, board)
    return _ended(board, place, code)


def show_robot(bus: BusConfig, seconds: float | None, place: Place) -> int:
    """Shows a robot; the exit code, 1 where not one pose came."""
    board = Board(place, layout(PANORAMA, depth=False))
    with _closing(board, place):
        Live(board).follow(bus, place, seconds)
    return _ended(board, place, int(not board.poses))


def _title(topic: str) -> str:
    """Of the pictures of a topic."""
    return "" if not topic else PANORAMA if topic.endswith("panorama") else "Lower camera"


@contextmanager
def _closing(board: Board, place: Place) -> Iterator[None]:
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


def _computed(log: Log, config: Config, settings: Path | None, board: Board) -> int:
    options = Options(quiet=log.quiet, settings=settings, map_every_s=MAP_EVERY_S,
                      watch=lambda place, telemetry: Computed(board, place, telemetry))
    return Replay(log.path, config, options).run(log.rig, log.topics)


def _recorded(found: Survey, topic: str, board: Board) -> int:
    recorded = Recorded(found, topic, board)
    recorded.show()
    if recorded.broken or recorded.damaged:
        print(f"omnid: warning: {found.path}: {recorded.broken} messages and {recorded.damaged} pieces of the file "
              "cannot be read and are left out", file=sys.stderr)
    if not board.poses:
        raise OmnidError(f"{found.path}: topic {topic!r} has no message that is a pose: is the recording cut?")
    return 0


def _most_messages(found: Survey, topic: str | None) -> int:
    """How many poses there will be at the most."""
    if topic is not None:
        return found.topics[topic][1]
    return max((count for kind, count in found.topics.values() if kind.startswith("sensor_msgs/msg/")), default=0)


def _ended(board: Board, place: Place, code: int) -> int:
    if board.poses:
        of_all = f" of {board.offered}" if board.offered > board.poses else ""
        print(f"{board.poses} poses{of_all} and {board.pictures} pictures shown")
    if board.poses and not place.left:
        print(place.leave(), flush=True)
    return code
