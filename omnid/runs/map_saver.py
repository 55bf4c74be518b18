"""Saving of the map during a live run: now and then, and on request."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from omnid.core.places.place_map import PlaceMap
from omnid.errors import OmnidError
from omnid.runs.place_maps import RunPlaces
from omnid.stages.places import Places
from omnid.transport.codec import ERROR, OK
from omnid.transport.navigation_codec import string_from_cdr
from omnid.transport.records import DiagnosticStatus
from omnid.transport.requests import MOST_OPEN, Answer, Request
from omnid.transport.status_names import MAP_FILE, Key
from omnid.transport.topics import SAVE_MAP

_LONGEST_REQUEST: Final = 64  # bytes


class MapSaver:
    """Saves the map of a live run now and then, so that a robot that is switched off loses little of it.

    A ticker calls it each PERIOD_S in a thread of its own: the stage copies the map after a pose, some 0.2 ms for 1,000
    keyframes, and this thread writes the copy and answers the requests.
    """

    PERIOD_S: Final = 1.0

    def __init__(
        self, run_places: RunPlaces, places: Places, every_s: float, answer: Callable[[int, Answer], object]
    ) -> None:
        """answer: takes the id of a request."""
        self._run_places, self._places, self._answer = run_places, places, answer
        self._every, self._ticks = max(1, round(every_s / self.PERIOD_S)), 0
        self._asked: deque[int] = deque(maxlen=MOST_OPEN)  # ids of requests of which the copy was not asked for
        self._waiting: deque[int] = deque(maxlen=MOST_OPEN)  # ids of requests for the copy that comes
        self._saves = self._failed = self._refused = 0
        self._error = ""  # of the last save; empty: it succeeded

    def __call__(self) -> None:
        """Write the copy of the map that has come; ask for the next one when it is due or requested."""
        copy = self._places.take_copy()
        if copy is not None:
            answer = self._save(copy)
            while self._waiting:
                self._answer(self._waiting.popleft(), answer)
        self._ticks += 1
        if self._ticks >= self._every or self._asked:
            self._ticks = 0
            while self._asked:
                self._waiting.append(self._asked.popleft())
            self._places.want_copy()

    def receive(self, request: Request) -> Answer | None:
        """Take a request from the bus, a String "save", from any thread; return the refusal of any other."""
        with suppress(OmnidError):
            if string_from_cdr(request.payload[:_LONGEST_REQUEST]) == SAVE_MAP:
                self._asked.append(request.id)
                return None
        self._refused += 1
        return Answer(False, f'a String "{SAVE_MAP}" was expected')

    def _save(self, copy: PlaceMap) -> Answer:
        try:
            is_new = self._run_places.save(copy)
        except OmnidError as error:
            self._failed += 1
            self._error = str(error)
            return Answer(False, f"the map is not saved: {error}")
        self._saves += is_new
        self._error = ""
        return Answer(True, "the map is saved" if is_new else "the map in the file has all that is known already")

    def status(self) -> DiagnosticStatus:
        """Return how often the map was saved, and why it is not."""
        values = {Key.SAVES: str(self._saves), "failed": str(self._failed), "refused": str(self._refused)}
        return DiagnosticStatus(MAP_FILE, ERROR if self._error else OK, self._error or "saves the map", values)
