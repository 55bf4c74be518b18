"""Commands, requests and samples of a live run: a table of topics and their receivers."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Final, TypeAlias

from omnid.controller.link import DriveLink
from omnid.core.control.arming import ArmAnswer
from omnid.core.control.command_sources import PLANNER
from omnid.core.control.safety_rules import NO_POSE
from omnid.core.navigation.requests import NavigationCommand
from omnid.engine.logging_setup import Report
from omnid.runs.map_saver import MapSaver
from omnid.runs.sensor_sources import SensorSources
from omnid.runs.session import Session
from omnid.transport.bus import Bus
from omnid.transport.commands import CommandReceiver
from omnid.transport.navigation_commands import NavigationReceiver
from omnid.transport.requests import Answer, Request
from omnid.transport.stamps import StampRule
from omnid.transport.status_names import DISARMED_BY_STOP
from omnid.transport.topics import ARM, MAP, MAP_TOPICS, NAVIGATION_TOPICS, SENSOR_TOPICS, command_topics

Receive: TypeAlias = Callable[[Request], Answer | None]  # returns None where there is no answer, or not yet
NO_MOTOR: Final = "the daemon runs without a motor: set motor.port, or start it with --motor"
NO_PLANNER: Final = f"controller.sources.names lacks {PLANNER!r}: goals, paths and routes are off"
NO_MAP_FILE: Final = (
    "the robot keeps no map in a file: start its daemon with --map FILE.omap, or set places.map, "
    "without --localize-only"
)


class LiveCommands:
    """The receivers of commands, requests and samples; without a motor only samples and requests to save the map."""

    def __init__(
        self,
        session: Session,
        bus: Bus,
        controller: DriveLink | None,
        navigate: Callable[[NavigationCommand], None],
        report: Report,
    ) -> None:
        """navigate: takes requests to the navigation. report: takes lines for the log, with a level of `logging`."""
        self._session, self._bus, self._controller = session, bus, controller
        settings, warn = session.config.controller, partial(report, logging.WARNING)
        stamps = StampRule(
            settings.deadlines.command_s, synchronised=session.config.bus.command_clock == "synchronised"
        )
        self.navigation = NavigationReceiver(navigate, stamps, report=warn)
        self.commands: CommandReceiver | None = None
        if controller is not None:
            self.commands = CommandReceiver(
                controller, stamps, sources=settings.sources.names, is_unique=lambda: bus.is_unique, report=warn
            )
            controller.statistics.take_arm_answer = self._answer_arm

    def subscribe(self, sensors: SensorSources, saver: MapSaver | None) -> None:
        """Begin to receive."""
        sources = self._session.config.controller.sources.names
        topics = command_topics(sources) if self.commands else {**SENSOR_TOPICS, **MAP_TOPICS}
        table: dict[str, Receive] = {}
        if self.commands:
            navigate = self.navigation.receive if PLANNER in sources else _refusing(NO_PLANNER)
            table = {topic: self.commands.receive for topic in topics} | dict.fromkeys(NAVIGATION_TOPICS, navigate)
        table |= {
            topic: lambda request: sensors.receiver.receive(request.topic, request.payload) for topic in SENSOR_TOPICS
        }
        table[MAP] = _refusing(NO_MAP_FILE) if saver is None else saver.receive
        others = self.commands.receive if self.commands else _refusing(NO_MOTOR)  # counts unknown topics

        def receive(request: Request) -> None:
            answer = table.get(request.topic, others)(request)
            if answer is not None:
                self._bus.answer(request.id, answer)

        self._bus.subscribe_commands(receive, topics, self._is_stopped)

    def _is_stopped(self) -> bool:
        """True if a stop holds."""
        return self._controller is not None and self._controller.statistics.state.disarmed_by == DISARMED_BY_STOP

    def _answer_arm(self, answer: ArmAnswer) -> None:
        """Pass on the controller's answer; of several requests at once it answers the newest."""
        text = answer.refusal or "armed: it obeys commands from now on"
        if answer.refusal == NO_POSE:
            text = f"{NO_POSE}: {self._why_no_pose()}"
        self._bus.answer(answer.id, Answer(not answer.refusal, text), also_before=ARM)

    def _why_no_pose(self) -> str:
        """Return what is missing for the first pose."""
        if not self._session.graph.telemetry.of("pair").processed:
            return "no images have come from the cameras (`omnid listen`, `omnid doctor`)"
        return "the first images are being processed: try again in a moment (`omnid listen` tells what they show)"


def _refusing(reason: str) -> Receive:
    return lambda _: Answer(False, reason)
