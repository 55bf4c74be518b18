"""Commands from the bus: a ring for each topic, and one pass over them in the order that is safe."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import zenoh

from omnid.transport import ros2
from omnid.transport.bus_config import BusConfig
from omnid.transport.intake import UNKNOWN, Intake, budget_of
from omnid.transport.topics import ARM, STOP

# Key from `cmd` on, payload, identity of the sender, time of sending [ns of Unix time].
CommandCallback = Callable[[str, bytes, str, int], None]
PERIOD_S: Final = 0.004  # between two passes
_UNKNOWN: Final = "cmd/**"
_LAST: Final = (ARM, STOP)


class CommandIntake:
    """Passes commands on within the budgets of their keys, by `process`, which one thread calls again and again."""

    def __init__(self, session: zenoh.Session, config: BusConfig, topics: Mapping[str, str], callback: CommandCallback
                 ) -> None:
        """topics: those with a ring of their own; all others below `cmd` share one."""
        self._callback = callback
        self._topics = frozenset((*topics, *_LAST))
        self._declared: list[object] = []  # zenoh undeclares what is no longer referred to
        prefixes = [f"{config.robot}/"]
        if config.ros2 == "rmw_zenoh":
            prefixes.append(f"{config.ros2_domain}/{config.robot}/")
        ordered = [*sorted(self._topics - {*_LAST}), _UNKNOWN, *_LAST]
        self._rings = [(topic, self._declare(session, prefix, topic, is_ros=prefix != prefixes[0]), len(prefix))
                       for topic in ordered for prefix in prefixes]
        self._stops = [ring for topic, ring, _ in self._rings if topic == STOP]

    @property
    def intakes(self) -> Sequence[Intake[zenoh.Sample]]:
        """The rings, with what they have refused."""
        return [ring for _, ring, _ in self._rings]

    def process(self) -> None:
        """Pass on what has come: stops first, and again after the requests to arm that came with them.

        The order of messages of different topics is not known: of a stop and a request to arm in one pass the stop
        wins.
        """
        stopped, asked_to_arm = self._stop(), False
        for topic, ring, prefix_length in self._rings:
            if topic == STOP:
                continue
            for sample in ring.messages():
                asked_to_arm |= topic == ARM
                self._pass_on(topic, sample, prefix_length)
        if asked_to_arm and not self._stop() and stopped:
            self._callback(STOP, b"", "", 0)

    def _stop(self) -> bool:
        """Pass on the stops that have come; return whether there was one."""
        samples = [sample for ring in self._stops for sample in ring.messages()]
        if samples:
            self._callback(STOP, samples[-1].payload.to_bytes(), sender_of(samples[-1]), 0)
        return bool(samples)

    def _pass_on(self, topic: str, sample: zenoh.Sample, prefix_length: int) -> None:
        if topic == _UNKNOWN:
            key = str(sample.key_expr)[prefix_length:]
            topic = key if prefix_length == self._rings[0][2] else key.rsplit("/", 2)[0]  # its type and their hash
            if topic in self._topics:
                return
        self._callback(topic, sample.payload.to_bytes(), sender_of(sample), _sent_ns(sample))

    def _declare(self, session: zenoh.Session, prefix: str, topic: str, *, is_ros: bool) -> Intake[zenoh.Sample]:
        budget = UNKNOWN if topic == _UNKNOWN else budget_of(topic)
        key = f"{prefix}{topic}/*/*" if is_ros and topic != _UNKNOWN else f"{prefix}{topic}"
        subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(budget.burst))
        self._declared.append(subscriber)
        return Intake(topic, subscriber.try_recv, budget, sender_of)


def sender_of(sample: zenoh.Sample) -> str:
    """Return the identity of the program that sent a sample, empty where it names none.

    Programs with omnid.client give the source of their messages, those of rmw_zenoh the gid of their publisher; zenoh
    itself adds nothing. No proof: permissions are those of the access rules.
    """
    if sample.source_info is not None:
        return str(sample.source_info.source_id.zid)
    return "" if sample.attachment is None else ros2.gid_in(sample.attachment.to_bytes())


def _sent_ns(sample: zenoh.Sample) -> int:
    """Return the time of sending that omnid.client and rmw_zenoh attach to a sample, 0 without."""
    return 0 if sample.attachment is None else ros2.sent_ns_in(sample.attachment.to_bytes())
