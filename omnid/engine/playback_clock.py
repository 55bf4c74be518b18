"""Playback of a log at the rate at which it was recorded."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar


class Stamped(Protocol):
    """A message with a time."""

    @property
    def stamp_ns(self) -> int:
        """Time of the message."""


Message = TypeVar("Message", bound=Stamped)
_POLL_S = 0.05  # longest sleep, so that `wake` takes effect soon


class PlaybackClock:
    """Delays messages to the intervals of their stamps; `wake` ends all waiting."""

    def __init__(self) -> None:
        self._awake = False

    def wake(self) -> None:
        """End all waiting: the rest of the messages comes without delay."""
        self._awake = True

    def messages(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Yield messages, each when its stamp is due; the first one at once."""
        offset_ns: int | None = None
        for message in messages:
            if offset_ns is None:
                offset_ns = time.monotonic_ns() - message.stamp_ns
            self._wait(message.stamp_ns + offset_ns)
            yield message

    def _wait(self, until_ns: int) -> None:
        while not self._awake and (left_s := (until_ns - time.monotonic_ns()) * 1e-9) > 0:
            time.sleep(min(left_s, _POLL_S))
