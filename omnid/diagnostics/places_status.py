"""Status of the map of places."""

from __future__ import annotations

from omnid.stages.places import Places
from omnid.tracking_state import MapState
from omnid.transport.codec import ERROR, OK
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import PLACES, Key


def places_status(places: Places) -> DiagnosticStatus:
    """Return the state of the pose in the map, and the sizes and counters of the map."""
    state = places.state
    values = {str(Key.STATE): str(state)} | {name: str(count) for name, count in places.counts.items()}
    return DiagnosticStatus(PLACES, ERROR if state is MapState.LOST else OK, state, values)
