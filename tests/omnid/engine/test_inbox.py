"""Inboxes: bounded, with the newest messages or all of them, and ready when the reader behind them is."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial

import pytest

from omnid.engine.graph import LOSSLESS, NEWEST, Graph
from tests.omnid.engine.graph_parts import LONG_S, Apply, Collect

pytestmark = pytest.mark.usefixtures("no_thread_is_left")


def test_lossless_waits_for_a_slow_reader_with_a_bounded_inbox() -> None:
    graph, slow = Graph(policy=LOSSLESS, depth=3), Collect()
    produced: list[int] = []
    ahead: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(300):
            produced.append(number)
            yield number

    def crawl(message: int) -> int:
        threading.Event().wait(1e-4)
        ahead.append(len(produced) - message)
        return message

    graph.sink("slow", slow, graph.stage("crawl", Apply(crawl), graph.source("numbers", numbers)))
    graph.run()
    assert slow.got == list(range(300))
    assert max(ahead) <= 3 + 2  # the inbox, one message at the writer, one at the reader
    assert [row.drops for row in graph.telemetry.summary()] == [0, 0, 0]


def test_newest_drops_the_oldest_and_counts_it() -> None:
    graph, slow, fast, all_sent = Graph(policy=NEWEST, depth=2), Collect(), Collect(), threading.Event()

    def numbers() -> Iterator[int]:
        yield from range(50)
        all_sent.set()

    def hold(message: int) -> int:
        assert all_sent.wait(LONG_S)
        return message

    stream = graph.source("numbers", numbers)
    graph.sink("slow", slow, graph.stage("hold", Apply(hold), stream), policy=LOSSLESS)
    graph.sink("fast", fast, stream, policy=LOSSLESS)
    graph.run()
    assert fast.got == list(range(50))  # the policy of the sink
    assert slow.got[-2:] == [48, 49]
    assert len(slow.got) in (2, 3)  # and perhaps the first one
    counted = {stats.name: (stats.processed, stats.dropped) for stats in graph.telemetry.stages}
    assert counted["hold"] == (len(slow.got), 50 - len(slow.got))
    assert counted["numbers"] == counted["fast"] == (50, 0)


def test_a_failed_reader_releases_its_waiting_writer() -> None:
    graph, third = Graph(depth=1), threading.Event()

    def numbers() -> Iterator[int]:
        yield from (0, 1)
        third.set()  # one message in process, one in the inbox: the next one has to wait
        yield 2

    def fail(message: int) -> int:
        assert third.wait(LONG_S)
        raise ValueError(f"cannot take {message}")

    graph.stage("fragile", Apply(fail), graph.source("numbers", numbers))
    with pytest.raises(ValueError, match="cannot take 0"):
        graph.run()
    assert [(row.n, row.drops) for row in graph.telemetry.summary()] == [(3, 0), (0, 2)]


class Held:
    """Holds the first message until all were sent; of dropped messages it keeps the parts."""

    def __init__(self, all_sent: threading.Event) -> None:
        self._all_sent = all_sent

    def process(self, parts: tuple[int, ...]) -> tuple[int, ...]:
        assert self._all_sent.wait(LONG_S)
        return parts

    def merge(self, older: tuple[int, ...], newer: tuple[int, ...]) -> tuple[int, ...]:
        return older + newer


@pytest.mark.parametrize("depth", [1, 3])
def test_parts_of_dropped_messages_go_along_with_the_next_one_of_their_writer(depth: int) -> None:
    graph, out, all_sent = Graph(policy=NEWEST, depth=depth), Collect(), threading.Event()
    sent = [threading.Event(), threading.Event()]

    def parts(first: int, done: threading.Event) -> Iterator[tuple[int, ...]]:
        yield from ((number,) for number in range(first, first + 20))
        done.set()
        if all(event.is_set() for event in sent):
            all_sent.set()

    streams = [
        graph.source(name, partial(parts, first, done)) for name, first, done in zip("ab", (0, 100), sent, strict=True)
    ]
    graph.sink("out", out, graph.stage("held", Held(all_sent), *streams), policy=LOSSLESS)
    graph.run()
    found = [number for message in out.got for number in message]
    assert len(out.got) <= 2 * depth + 1 and graph.telemetry.of("held").dropped == 40 - len(out.got)
    for first in (0, 100):  # nothing is lost, twice or mixed, and the newest messages are whole by themselves
        assert [number for number in found if number // 100 == first // 100] == list(range(first, first + 20))
        assert depth == 1 or (first + 19,) in out.got
    assert all(len({number // 100 for number in message}) == 1 for message in out.got)
