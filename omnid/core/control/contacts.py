"""Bumpers and cliff sensors: from programs on the bus, and from the motor controller's own reports."""

from __future__ import annotations

from typing import Final, NamedTuple

BUMPER: Final = "the bumper is pressed"
CLIFF: Final = "a cliff sensor sees no floor"
LATCHING: Final = frozenset({BUMPER, CLIFF})  # as a stop that was asked for: only a request to arm releases them
BUS: Final = "bus"
MOTOR: Final = "motor"


class ContactState(NamedTuple):
    """State of the sensors of one origin; the counts show a contact that has begun and ended between two messages."""

    bumper: bool = False  # pressed now
    cliff: bool = False  # no floor now
    bumper_count: int = 0  # contacts so far
    cliff_count: int = 0

    def after(self, contact: str, *, holds: bool) -> ContactState:
        """Return the state after a message of one sensor (BUMPER, CLIFF)."""
        if contact == BUMPER:
            return self._replace(bumper=holds, bumper_count=self.bumper_count + (holds and not self.bumper))
        return self._replace(cliff=holds, cliff_count=self.cliff_count + (holds and not self.cliff))


NO_CONTACT: Final = ContactState()


class Contacts:
    """Follows the sensors of all origins."""

    def __init__(self) -> None:
        self._states: dict[str, ContactState] = {}
        self._begun: set[str] = set()  # since the last step

    def update(self, origin: str, state: ContactState) -> None:
        """Replace the state of an origin."""
        before, self._states[origin] = self._states.get(origin, NO_CONTACT), state
        begun = {BUMPER: state.bumper_count > before.bumper_count, CLIFF: state.cliff_count > before.cliff_count}
        self._begun |= {contact for contact, has_begun in begun.items() if has_begun}

    def take(self) -> set[str]:
        """Return the contacts that hold, or have begun since the last call."""
        found, self._begun = self._begun, set()
        for state in self._states.values():
            found |= {contact for contact, holds in ((BUMPER, state.bumper), (CLIFF, state.cliff)) if holds}
        return found
