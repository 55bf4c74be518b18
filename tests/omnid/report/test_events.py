"""Events in bounded memory: repeated ones are merged, and late ones are not left out in favour of early ones."""

from __future__ import annotations

from omnid.report.events import ERROR, MAX_PER_SOURCE, MAX_SOURCES, WARNING, Event, Events


def test_a_counter_that_keeps_rising_is_one_event() -> None:
    events = Events()
    for t_s in (1.0, 2.0, 3.0, 9.0):
        events.add(Event(t_s, t_s, WARNING, "camera", "images dropped", 2))
    assert [(e.start_s, e.end_s, e.count) for e in events.in_order()] == [(1.0, 3.0, 6), (9.0, 9.0, 2)]


def test_few_changes_of_state_stay_separate() -> None:
    events = Events()
    for k in range(MAX_PER_SOURCE):
        events.add(Event(0.1 * k, 0.1 * k, ERROR, "state", ("lost", "tracking")[k % 2]))
    assert len(events.in_order()) == MAX_PER_SOURCE and {e.count for e in events.in_order()} == {0}


def test_many_events_are_merged_up_to_the_last() -> None:
    events = Events()
    for k in range(10_000):
        events.add(Event(10.0 * k, 10.0 * k, ERROR, "state", ("lost", "tracking")[k % 2]))
    found = events.in_order()
    assert len(found) <= MAX_PER_SOURCE and sum(event.count for event in found) == 10_000
    assert max(event.end_s for event in found) == 99_990.0 and not events.left_out


def test_events_that_cannot_be_merged_are_counted() -> None:
    events = Events()
    for k in range(1000):
        events.add(Event(float(k), float(k), WARNING, "part", "x" * (k % 150)))
        events.add(Event(float(k), float(k), WARNING, f"source {k}", "expected"))
    assert len(events.in_order()) <= MAX_PER_SOURCE + MAX_SOURCES + 1
    assert sum(max(1, event.count) for event in events.in_order()) + sum(events.left_out.values()) == 2000


def test_events_that_differ_in_digits_only_are_merged() -> None:
    events = Events()
    for k in range(100):
        events.add(Event(float(k), float(k), WARNING, "poses", f"none for {k}.25 s"))
    assert len(events.in_order()) <= MAX_PER_SOURCE and not events.left_out
