"""A robot as it drives, heard on the bus."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Final, TypeVar

from drivers.errors import BrokenFrame
from drivers.ros_image import COMPRESSED_IMAGE, parse_image
from omnid.client import Cloud, Report, Robot
from omnid.errors import OmnidError
from omnid.listening.heard import Heard, Letter, Mailbox
from omnid.transport.bus_config import BusConfig
from omnid.transport.decode import cloud_from, report_from
from omnid.viewing import reports
from omnid.viewing.board import Board
from omnid.viewing.pictures import compressed
from omnid.viewing.places import Place

T = TypeVar("T")
PATIENCE_S: Final = 5.0
LOOKS_S: Final = 0.5  # between two looks whether anybody is there still


class Live:
    """Draws what comes of a robot; broken: messages that could not be read."""

    def __init__(self, board: Board) -> None:
        self._board, self._changes = board, reports.Changes()
        self.heard, self.broken = Heard(), 0

    def follow(self, bus: BusConfig, place: Place, seconds: float | None) -> None:
        """Draws until Ctrl-C, until nobody looks any more, or for so many seconds. Unreachable where nobody answers."""
        end_s = math.inf if seconds is None else time.monotonic() + seconds
        with suppress(KeyboardInterrupt), Robot(settings=bus, patience_s=PATIENCE_S) as robot:
            mailbox = Mailbox()
            robot.each(mailbox.take)
            self._late(robot)
            while time.monotonic() < end_s and not place.left:
                letter = mailbox.next(LOOKS_S)
                if letter is not None:
                    self.take(letter)

    def _late(self, robot: Robot) -> None:
        """What was said before we came."""
        for report in _newest(robot, Report):
            self._report(report)
        for cloud in _newest(robot, Cloud):
            self._board.cloud(cloud)

    def take(self, letter: Letter) -> None:
        """Draws a message, if it can be drawn."""
        try:
            self._draw(letter)
        except (OmnidError, BrokenFrame):
            self.broken += 1

    def _draw(self, letter: Letter) -> None:
        pose = self.heard.take(letter)
        if pose is not None:
            self._board.pose(pose)
            age_ms = 1e-6 * (letter.received_ns - pose.stamp_ns)
            self._board.latency(pose.stamp_ns, ("here", "age"), age_ms)
        elif letter.topic == "cloud":
            self._board.cloud(cloud_from(letter.payload))
        elif letter.topic == "status":
            self._report(report_from(letter.payload))
        elif letter.topic == "panorama" and self._board.wants("picture"):
            image = parse_image(COMPRESSED_IMAGE, memoryview(letter.payload))
            self._board.panorama(image.stamp_ns, *compressed(image))

    def _report(self, report: Report) -> None:
        reports.draw(report, self._changes, self._board)


def _newest(robot: Robot, kind: type[T]) -> Iterator[T]:
    """The newest of a kind that a robot has said, if any."""
    subscription = robot.subscribe(kind)
    newest = subscription.newest()
    subscription.close()
    if newest is not None:
        yield newest
