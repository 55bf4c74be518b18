"""Queries wait for their answers, in bounded memory; an answer may decide about earlier ones."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import zenoh

from omnid.client import Answer
from omnid.transport.open_requests import OpenRequests
from omnid.transport.requests import MOST_OPEN, answer_of
from tests.omnid.transport.bus_fixtures import robot
from tests.waiting import wait_until


@pytest.mark.parametrize("answer", [Answer(True, "driving"), Answer(False, "not armed: d\u00e9sarm\u00e9\n" * 50)])
def test_a_request_gets_the_answer_that_is_given_later(answer: Answer) -> None:
    with robot() as (bus, program, received), ThreadPoolExecutor(1) as thread:
        asked = thread.submit(program.driver().route, "repeat hall")
        wait_until(lambda: bool(received))
        assert received[0].topic == "cmd/route" and received[0].sender and received[0].id > 0
        assert abs(received[0].sent_ns - time.time_ns()) < 60 * 10**9 and not asked.done()
        bus.answer(received[0].id, answer)
        bus.answer(received[0].id, Answer(False, "a second one"))
        assert asked.result() == answer


def test_an_answer_may_decide_about_earlier_requests_too() -> None:
    with robot() as (bus, program, received), ThreadPoolExecutor(3) as threads:
        arms = []
        for count in (1, 2):
            arms.append(threads.submit(program.driver().arm))
            wait_until(lambda count=count: len(received) == count)
        pause = threads.submit(program.driver().navigate, "pause")
        wait_until(lambda: len(received) == 3)
        bus.answer(received[1].id, Answer(True, "armed"), also_before="cmd/arm")
        assert [arm.result().text for arm in arms] == ["armed", "armed"]
        bus.answer(received[2].id, Answer(True, "paused"))
        assert pause.result().text == "paused"


def test_requests_that_wait_take_bounded_memory() -> None:
    with zenoh.open(
        zenoh.Config.from_json5('{mode: "peer", listen: {endpoints: []}, scouting: {multicast: {enabled: false}}}')
    ) as session:
        queries = session.declare_queryable("x", zenoh.handlers.FifoChannel(2 * MOST_OPEN))
        waiting = [session.get("x", timeout=30.0) for _ in range(2 * MOST_OPEN)]
        requests = OpenRequests()
        ids = [requests.add("cmd/arm", queries.recv()) for _ in waiting]
        for id in (ids[0], ids[-1]):
            requests.answer(id, Answer(True, str(id)))
        requests.send()
        del requests  # ends those that are open
        texts = [[answer_of(reply.ok.payload.to_bytes()) for reply in replies if reply.ok] for replies in waiting]
    assert texts == [[]] * (2 * MOST_OPEN - 1) + [[Answer(True, str(ids[-1]))]], "the oldest were given up"
