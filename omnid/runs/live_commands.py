"""Commands, requests and samples of a live run: a table of topics and their receivers."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import TypeAlias

from omnid.controller.link import DriveLink
from omnid.runs.map_saver import MapSaver
from omnid.runs.sensor_sources import SensorSources
from omnid.runs.session import Session
from omnid.sinks.command_log import command_recorder
from omnid.sinks.recorder import Recorder
from omnid.transport.bus import Bus
from omnid.transport.commands import CommandReceiver
from omnid.transport.navigation_commands import NavigationReceiver, RequestQueue
from omnid.transport.stamps import StampRule
from omnid.transport.status_names import DISARMED_BY_STOP
from omnid.transport.topics import MAP, MAP_TOPICS, NAVIGATION_TOPICS, SENSOR_TOPICS, command_topics

Receive: TypeAlias = Callable[[str, bytes, str, int], None]  # key, payload, sender, time of sending [ns, 0: unknown]


class LiveCommands:
    """The receivers of commands, requests and samples; without a motor only samples and requests to save the map."""

    def __init__(self, session: Session, bus: Bus, controller: DriveLink | None, requests: RequestQueue,
                 report: Callable[[int, str], None]) -> None:
        """requests: to the navigation. report: takes lines for the log, with a level of `logging`."""
        self._session, self._bus, self._controller = session, bus, controller
        settings, warn = session.config.controller, partial(report, logging.WARNING)
        stamps = StampRule(settings.deadlines.command_s,
                           synchronised=session.config.bus.command_clock == "synchronised")
        self.navigation = NavigationReceiver(requests.put, stamps, report=warn)
        self.commands = None if controller is None else CommandReceiver(
            controller, stamps, sources=settings.sources.names, is_unique=lambda: bus.is_unique, report=warn)

    def subscribe(self, recorder: Recorder | None, sensors: SensorSources, saver: MapSaver | None) -> None:
        """Begin to receive; a command is recorded after it was passed on, because a stop must not wait."""
        sources = self._session.config.controller.sources.names
        topics = command_topics(sources) if self.commands else {**SENSOR_TOPICS, **MAP_TOPICS}
        table: dict[str, Receive] = {}
        if self.commands:
            table = {key: self.commands.receive for key in topics}
            table |= {key: lambda key, payload, _, sent_ns: self.navigation.receive(key, payload, sent_ns)
                      for key in NAVIGATION_TOPICS}
            if recorder is not None:
                record = command_recorder(recorder, self._session.now_ns, topics)
                table = {key: _recorded(receive, record) for key, receive in table.items()}
        # Samples are recorded with the poses.
        table |= {key: lambda key, payload, *_: sensors.receiver.receive(key, payload) for key in SENSOR_TOPICS}
        table[MAP] = _ignored if saver is None else lambda _key, payload, *_: saver.receive(payload)

        def receive(key: str, payload: bytes, sender: str, sent_ns: int) -> None:
            handle = table.get(key) or (self.commands.receive if self.commands else _ignored)  # counts unknown topics
            handle(key, payload, sender, sent_ns)

        self._bus.subscribe_commands(receive, topics, self._is_stopped)

    def _is_stopped(self) -> bool:
        """True if a stop holds."""
        return self._controller is not None and self._controller.statistics.state.disarmed_by == DISARMED_BY_STOP


def _recorded(receive: Receive, record: Callable[[str, bytes], None]) -> Receive:
    def receive_and_record(key: str, payload: bytes, sender: str, sent_ns: int) -> None:
        receive(key, payload, sender, sent_ns)
        record(key, payload)

    return receive_and_record


def _ignored(*_: object) -> None:
    pass
