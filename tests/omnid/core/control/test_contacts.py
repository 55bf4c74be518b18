"""Bumpers and cliff sensors of several origins: what holds, and what began and ended between two steps."""

from __future__ import annotations

import random

from omnid.core.control.contacts import BUMPER, BUS, CLIFF, MOTOR, NO_CONTACT, Contacts, ContactState


def test_a_message_changes_its_sensor_only_and_counts_each_beginning() -> None:
    state = NO_CONTACT
    assert state == ContactState(bumper=False, cliff=False, bumper_count=0, cliff_count=0)
    for holds, count in ((True, 1), (True, 1), (False, 1), (True, 2)):
        state = state.after(BUMPER, holds=holds)
        assert state == ContactState(bumper=holds, bumper_count=count)
    for holds, count in ((False, 0), (True, 1), (True, 1), (False, 1), (True, 2)):
        state = state.after(CLIFF, holds=holds)
        assert state == ContactState(bumper=True, cliff=holds, bumper_count=2, cliff_count=count)


def test_no_contact_is_lost_and_none_is_made_up() -> None:
    """Any messages of two origins: a contact is reported while it holds, and once where it has passed since."""
    rng, seen = random.Random(1), set()
    contacts, states = Contacts(), {BUS: NO_CONTACT, MOTOR: NO_CONTACT}
    for _ in range(3000):
        found: set[str] = set()
        for _ in range(rng.choice((0, 0, 1, 3))):
            origin, contact, holds = rng.choice((BUS, MOTOR)), rng.choice((BUMPER, CLIFF)), rng.random() < 0.3
            held = states[origin].bumper if contact == BUMPER else states[origin].cliff
            found |= {contact} if holds and not held else set()
            states[origin] = states[origin].after(contact, holds=holds)
            if rng.random() < 0.6:  # else a later message of the same origin replaces this one before it is taken
                contacts.update(origin, states[origin])
        for origin, state in states.items():
            contacts.update(origin, state)
            found |= {CLIFF} if state.cliff else set()
            found |= {BUMPER} if state.bumper else set()
        expected = CLIFF if CLIFF in found else BUMPER if BUMPER in found else ""
        assert contacts.take() == expected
        seen.add(expected)
    assert seen == {CLIFF, BUMPER, ""}
