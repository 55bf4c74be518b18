"""Saving of the map of a live run while it goes on: now and then, and when it is asked for."""

from __future__ import annotations

from typing import Final

from omnid.core.places.place_map import PlaceMap
from omnid.errors import OmnidError
from omnid.runs.place_maps import RunPlaces
from omnid.stages.places import Places
from omnid.transport.codec import ERROR, OK, DiagnosticStatus
from omnid.transport.navigation_codec import string_from_cdr
from omnid.transport.status_names import MAP_FILE, Key
from omnid.transport.topics import SAVE_MAP

_LONGEST_REQUEST: Final = 64  # bytes


class MapSaver:
    """Saves the map of a live run now and then, so that a robot that is switched off loses little of it.

    A ticker calls it each PERIOD_S in a thread of its own: the stage copies the map after a pose, some 0.2 ms for 1,000
    keyframes, and this thread writes the copy. Requests are answered in the status: `answered` counts them.
    """

    PERIOD_S: Final = 1.0

    def __init__(self, run_places: RunPlaces, places: Places, every_s: float) -> None:
        self._run_places, self._places = run_places, places
        self._every, self._ticks = max(1, round(every_s / self.PERIOD_S)), 0
        self._asked = self._wanted = self._answered = self._refused = 0  # requests: all, of the copy that comes, done
        self._saves = self._failed = 0
        self._error = ""  # of the last save; empty: it succeeded

    def __call__(self) -> None:
        """Write the copy of the map that has come; ask for the next one when it is due or requested."""
        copy = self._places.take_copy()
        if copy is not None:
            self._save(copy)
        self._ticks += 1
        if self._ticks >= self._every or self._asked != self._wanted:
            self._ticks, self._wanted = 0, self._asked
            self._places.want_copy()

    def receive(self, payload: bytes) -> None:
        """Take a request from the bus, a String "save"; from any thread."""
        try:
            is_asked = string_from_cdr(payload[:_LONGEST_REQUEST]) == SAVE_MAP
        except OmnidError:
            is_asked = False
        self._asked += is_asked
        self._refused += not is_asked

    def _save(self, copy: PlaceMap) -> None:
        try:
            self._saves += self._run_places.save(copy)
            self._error = ""
        except OmnidError as error:
            self._failed += 1
            self._error = str(error)
        self._answered = self._wanted

    def status(self) -> DiagnosticStatus:
        """Return how often the map was saved, and why it is not."""
        values = {Key.SAVES: str(self._saves), "failed": str(self._failed), Key.ANSWERED: str(self._answered),
                  "refused": str(self._refused)}
        return DiagnosticStatus(MAP_FILE, ERROR if self._error else OK, self._error or "saves the map", values)
