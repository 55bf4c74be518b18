"""Requests to a robot and their answers: queries for `<robot>/@request/NAME` with the message of `cmd/NAME`.

The time of sending and the identity of the sender are attached, as to a message. The answer is JSON, such as
{"done": false, "text": "not armed: ..."}. (An error of zenoh would not do: it makes one itself after the timeout.)
"""

from __future__ import annotations

import json
from typing import Final, NamedTuple

MOST_OPEN: Final = 64  # requests that wait for their answers; each holds a message in memory


class Request(NamedTuple):
    """A message to the robot."""

    topic: str  # from `cmd` on
    payload: bytes = b""
    sender: str = ""  # identity of the program that sent it, empty if unknown
    sent_ns: int = 0  # of Unix time, for a message without stamp; 0: it does not say it
    id: int = 0  # rises with each message
    echo_ns: int = 0  # the robot's own time as the sender repeats it (omnid.transport.commands); 0: it does not


class Answer(NamedTuple):
    """The answer to a request."""

    done: bool
    text: str  # what was done, or why not with the remedy


def answer_of(payload: bytes) -> Answer | None:
    """Decode an answer; None for any other bytes."""
    try:
        found = json.loads(payload)
        return Answer(bool(found["done"]), str(found["text"]))
    except (ValueError, TypeError, LookupError, RecursionError):
        return None
