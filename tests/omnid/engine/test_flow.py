"""Streams, slots and stages that run in the thread of the one before."""

from __future__ import annotations

import threading

import pytest

from omnid.engine.graph import Graph, Slot
from tests.omnid.engine.graph_parts import Collect, both

pytestmark = pytest.mark.usefixtures("no_thread_is_left")


@both
def test_a_slot_as_a_sink_keeps_the_newest(threaded: bool) -> None:
    slot: Slot[int] = Slot()
    assert slot.get() is None
    graph = Graph(threaded=threaded)
    graph.sink("newest", slot, graph.source("numbers", lambda: range(10)))
    graph.run()
    assert slot.get() == 9
    slot.put(3)
    assert slot.get() == 3


def test_direct_stages_and_sinks_run_in_the_thread_of_the_one_before() -> None:
    names: list[str] = []

    class Named:
        def process(self, number: int) -> int:
            names.append(threading.current_thread().name)
            return number

    graph, out = Graph(), Collect()
    first = graph.stage("first", Named(), graph.source("numbers", lambda: iter(range(3))))
    graph.sink("out", out, graph.stage("second", Named(), first, direct=True))
    graph.sink("third", Named(), first, direct=True)
    graph.run()
    assert set(names) == {"first"} and out.got == [0, 1, 2]
    assert [stats.processed for stats in graph.telemetry.stages if stats.name in ("second", "third")] == [3, 3]
