"""Saving of the map of a live run while it goes on."""

from __future__ import annotations

from typing import Final

from omnid.errors import OmnidError
from omnid.runs.place_maps import RunPlaces
from omnid.stages.places import Places
from omnid.transport.codec import ERROR, OK, DiagnosticStatus
from omnid.transport.status_names import MAP_FILE


class MapSaver:
    """Saves the map of a live run now and then, so that a robot that is switched off loses little of it.

    A ticker calls it each PERIOD_S in a thread of its own: the stage copies the map after a pose, some 0.2 ms for 1,000
    keyframes, and this thread writes the copy.
    """

    PERIOD_S: Final = 1.0

    def __init__(self, run_places: RunPlaces, places: Places, every_s: float) -> None:
        self._run_places, self._places = run_places, places
        self._every, self._ticks = max(1, round(every_s / self.PERIOD_S)), 0
        self._saves = self._failed = 0
        self._error = ""  # of the last save; empty: it succeeded

    def __call__(self) -> None:
        """Ask for a copy of the map when the time has come, and write the one that was asked for."""
        self._ticks += 1
        if self._ticks >= self._every:
            self._ticks = 0
            self._places.want_copy()
        copy = self._places.take_copy()
        if copy is None:
            return
        try:
            self._saves += self._run_places.save(copy)
            self._error = ""
        except OmnidError as error:
            self._failed += 1
            self._error = str(error)

    def status(self) -> DiagnosticStatus:
        """Return how often the map was saved, and why it is not."""
        values = {"saves": str(self._saves), "failed": str(self._failed)}
        return DiagnosticStatus(MAP_FILE, ERROR if self._error else OK, self._error or "saves the map", values)
