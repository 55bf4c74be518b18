"""Queries that wait for the answers to their requests."""

from __future__ import annotations

import json
from collections import deque
from contextlib import suppress
from itertools import count

import zenoh

from omnid.transport.requests import MOST_OPEN, Answer


class OpenRequests:
    """The queries that wait for their answers. Where there are too many, the oldest one is dropped."""

    def __init__(self) -> None:
        self._numbers = count(1)
        self._open: dict[int, tuple[str, zenoh.Query]] = {}
        self._answered: deque[tuple[zenoh.Query, Answer]] = deque(maxlen=MOST_OPEN)

    def add(self, topic: str, query: zenoh.Query | None) -> int:
        """Return the id of a message; query: what waits for the answer to it, None for a message that was put."""
        id = next(self._numbers)
        if query is not None:
            self._open[id] = topic, query
            if len(self._open) > MOST_OPEN:
                self._open.pop(min(self._open.copy()), None)
        return id

    def answer(self, id: int, answer: Answer, *, also_before: str = "") -> None:
        """Answer a request, once, from any thread, without waiting.

        also_before: a topic on which a request takes the place of earlier ones, which get the same answer.
        """
        for other, (topic, query) in self._open.copy().items():
            if (other == id or (other < id and topic == also_before)) and self._open.pop(other, None) is not None:
                self._answered.append((query, answer))

    def send(self) -> None:
        """Send the answers; this may block while a program does not read, so it has a thread of its own."""
        while self._answered:
            query, answer = self._answered.popleft()
            with suppress(zenoh.ZError):  # the program has gone
                query.reply(query.key_expr, json.dumps(answer._asdict()), encoding=zenoh.Encoding.APPLICATION_JSON)
