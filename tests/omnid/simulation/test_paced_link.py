"""The daemon's end of a controller in simulated time."""

from __future__ import annotations

import math
import threading

from drivers.motion import WheelSample
from drivers.motor import VelocityCommand
from omnid.controller.statistics import ControllerState, TickReport
from omnid.core.control.arming import ArmRequest
from omnid.engine.telemetry import StageStats
from omnid.simulation.paced_link import MOST_COMMANDS, PacedLink


class Kept:
    """A controller that keeps what reaches it."""

    def __init__(self) -> None:
        self.got: list[tuple[str, int]] = []

    def stop(self, asked_ns: int) -> None:
        self.got.append(("stop", asked_ns))

    def arm(self, request: ArmRequest) -> None:
        self.got.append(("arm", request.arrival_ns))


def test_messages_are_dated_by_the_simulated_clock() -> None:
    link, kept = PacedLink(StageStats("motor"), 100), Kept()
    link.stop()
    link.arm(ArmRequest(123, 456))
    for number, (due_ns, deliver) in enumerate(link.posted()):
        assert due_ns == 0
        deliver(kept, 7 + number)  # type: ignore[arg-type]
    assert kept.got == [("stop", 7), ("arm", 8)]
    assert list(link.posted()) == []


def test_commands_wait_for_the_stages_and_end_with_the_run() -> None:
    link = PacedLink(StageStats("motor"), 100)
    reports = [
        TickReport(VelocityCommand(k, 0.1, 0.0, 0.0), 0.0, 0.0, math.nan, ControllerState(), WheelSample(k, 0.1, 0.0))
        for k in range(3 * MOST_COMMANDS)
    ]
    ticking = threading.Thread(target=lambda: [link.take(report) for report in reports])
    ticking.start()
    taken = link.commands()
    assert [next(taken).stamp_ns for _ in reports] == list(range(len(reports)))
    ticking.join()
    link.end()
    assert list(taken) == []
