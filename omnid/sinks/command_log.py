"""Commands from the network, obeyed or not, written down as they came."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from omnid.errors import OmnidError
from omnid.sinks.encoder import OutgoingMessage
from omnid.sinks.frame_recorder import FrameRecorder
from omnid.transport.codec import message_from_cdr
from omnid.transport.commands import LONGEST_PAYLOAD
from omnid.transport.topics import EMPTY_SCHEMA, SUBSCRIBED

_EMPTY: Final = b"\0\1\0\0\0"  # std_msgs/msg/Empty in CDR: the head, and the one byte that stands for nothing


def keeper_of_commands(recorder: FrameRecorder, offset_ns: int) -> Callable[[str, bytes], None]:
    """What records key and payload of a command at the time of its arrival; from any thread, never raises.

    offset_ns: from CLOCK_MONOTONIC to Unix time.
    """

    def keep(key: str, payload: bytes) -> None:
        said = command_as_logged(key, payload)
        if said is not None:
            recorder.add(said, time.monotonic_ns() + offset_ns)

    return keep


def command_as_logged(key: str, payload: bytes) -> OutgoingMessage | None:
    """The message of a log, whatever came with a stop; None for what no reader could decode. Any bytes may come."""
    schema = SUBSCRIBED.get(key)
    if schema is None or len(payload) > LONGEST_PAYLOAD:
        return None
    if schema == EMPTY_SCHEMA:
        return OutgoingMessage(key, schema, _EMPTY)
    try:
        message_from_cdr(payload, schema)
    except OmnidError:
        return None
    return OutgoingMessage(key, schema, payload)
