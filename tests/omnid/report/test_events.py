"""Events in bounded memory: what repeats is put together, what happens late is not left out for what was early."""

from __future__ import annotations

from omnid.report.events import ERROR, MOST_OF_ONE, MOST_SOURCES, WARNING, Event, Events


def test_a_counter_that_keeps_rising_is_one_event() -> None:
    events = Events()
    for t_s in (1.0, 2.0, 3.0, 9.0):
        events.add(Event(t_s, t_s, WARNING, "camera", "images dropped", 2))
    assert [(e.start_s, e.end_s, e.count) for e in events.in_order()] == [(1.0, 3.0, 6), (9.0, 9.0, 2)]


def test_few_changes_of_state_are_told_one_by_one() -> None:
    events = Events()
    for k in range(MOST_OF_ONE):
        events.add(Event(0.1 * k, 0.1 * k, ERROR, "state", ("lost", "tracking")[k % 2]))
    assert len(events.in_order()) == MOST_OF_ONE and {e.count for e in events.in_order()} == {0}


def test_a_flood_is_put_together_and_reaches_to_its_end() -> None:
    events = Events()
    for k in range(10_000):
        events.add(Event(10.0 * k, 10.0 * k, ERROR, "state", ("lost", "tracking")[k % 2]))
    found = events.in_order()
    assert len(found) <= MOST_OF_ONE and sum(event.count for event in found) == 10_000
    assert max(event.end_s for event in found) == 99_990.0 and not events.beyond


def test_what_cannot_be_put_together_is_counted() -> None:
    events = Events()
    for k in range(1000):
        events.add(Event(float(k), float(k), WARNING, "part", "x" * (k % 150)))
        events.add(Event(float(k), float(k), WARNING, f"source {k}", "told"))
    assert len(events.in_order()) <= MOST_OF_ONE + MOST_SOURCES + 1
    assert sum(max(1, event.count) for event in events.in_order()) + sum(events.beyond.values()) == 2000


def test_figures_within_a_text_do_not_make_it_another() -> None:
    events = Events()
    for k in range(100):
        events.add(Event(float(k), float(k), WARNING, "poses", f"none for {k}.25 s"))
    assert len(events.in_order()) <= MOST_OF_ONE and not events.beyond
