"""Recording of the commands that arrive from the network, as they came, whether they were executed or refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from omnid.errors import OmnidError
from omnid.sinks.encoder import OutgoingMessage
from omnid.sinks.recorder import Recorder
from omnid.transport.codec import (
    TWIST_SCHEMA,
    is_plain_twist,
    message_from_cdr,
    plain_twist_from_cdr,
    twist_stamped_cdr,
)
from omnid.transport.commands import LONGEST_PAYLOAD
from omnid.transport.topics import EMPTY_SCHEMA

_EMPTY: Final = b"\0\1\0\0\0"  # std_msgs/msg/Empty in CDR: the encapsulation header and one byte


def command_recorder(
    recorder: Recorder, now_ns: Callable[[], int], topics: Mapping[str, str]
) -> Callable[[str, bytes], None]:
    """Return a function that records a command, by key and payload, at the time of its arrival.

    It may be called in any thread and never raises. now_ns: the time of the log. topics: of commands, with their types;
    others are not recorded.
    """

    def record(key: str, payload: bytes) -> None:
        message = logged_command(key, payload, topics)
        if message is not None:
            recorder.add(message, now_ns())

    return record


def logged_command(key: str, payload: bytes, topics: Mapping[str, str]) -> OutgoingMessage | None:
    """Return the message for the log; None for a payload that no reader could decode. Any bytes may come.

    A stop is recorded as an empty message, whatever its payload; a plain Twist as a TwistStamped with stamp 0.
    """
    schema = topics.get(key)
    if schema is None or len(payload) > LONGEST_PAYLOAD:
        return None
    if schema == EMPTY_SCHEMA:
        return OutgoingMessage(key, schema, _EMPTY)
    if schema == TWIST_SCHEMA and is_plain_twist(payload):
        return _stamped(key, payload)
    try:
        message_from_cdr(payload, schema)
    except OmnidError:
        return None
    return OutgoingMessage(key, schema, payload)


def _stamped(key: str, payload: bytes) -> OutgoingMessage | None:
    try:
        twist = plain_twist_from_cdr(payload)
    except OmnidError:
        return None
    return OutgoingMessage(key, TWIST_SCHEMA, twist_stamped_cdr(0, "", twist.velocity_mps, twist.yaw_rate_radps))
