"""The robot's voice: every message on the bus as `<robot>/odom` and the like."""

from __future__ import annotations

from omnid.messages import Odometry
from omnid.outputs.encoded import Encoder, Outgoing, StateReports
from omnid.transport.bus import Bus


class BusSink:
    """Publishes what the encoder makes; give it an inbox that forgets, for the bus may be slow."""

    def __init__(self, bus: Bus, encode: Encoder) -> None:
        self._bus, self._encode, self._states = bus, encode, StateReports(encode.offset_ns)

    def process(self, message: Outgoing) -> None:
        """Sends what there is to say about a message."""
        for topic, _, payload in self._encode(message):
            self._bus.publish(topic.removeprefix("/"), payload, realtime=topic == "odom")
        if isinstance(message, Odometry):
            for topic, _, payload in self._states(message):
                self._bus.publish(topic, payload)

    def finish(self) -> None:
        """Hangs up."""
        self._bus.close()
