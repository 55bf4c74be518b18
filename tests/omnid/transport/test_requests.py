"""Requests on the bus: a query has one answer, several keys at once are no request, and a stop comes first."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import zenoh

from omnid.client import Answer, Robot
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.open_requests import OpenRequests
from omnid.transport.requests import MOST_OPEN, Request, answer_of
from omnid.transport.topics import REQUEST_TOPICS, command_topics
from tests.omnid.transport.bus_fixtures import free_endpoint, wait_until


@contextlib.contextmanager
def robot() -> Iterator[tuple[Bus, Robot, list[Request]]]:
    """Yield a bus that keeps what comes, and a program on it."""
    endpoint, received = free_endpoint(), list[Request]()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as program:
        bus.subscribe_commands(received.append, command_topics(("operator",)))
        yield bus, program, received


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


def test_a_request_without_an_answer_is_an_error() -> None:
    with robot() as (_, program, received):
        with pytest.raises(OmnidError, match="omnid has not answered"):
            program.driver().arm(timeout_s=0.3)
        assert [request.topic for request in received] == ["cmd/arm"]
    endpoint = free_endpoint()
    with (
        contextlib.closing(Bus(BusConfig(listen=(endpoint,)))),
        Robot(connect=(endpoint,)) as program,
        pytest.raises(OmnidError, match=r"no robot 'omnid' takes such requests there \(robots there: omnid\)"),
    ):
        program.driver().arm()


def test_a_query_for_several_keys_is_no_request() -> None:
    """Else one query would arm the robots of a whole site, and give each topic a payload of another."""
    with robot() as (_, program, received):
        for key in ("**", "omnid/**", "*/@request/arm", "omnid/@request/*", "**/@request/**", "omnid/*/arm"):
            assert list(program._session.get(key, payload=codec.header_cdr(time.time_ns()), timeout=1.0)) == [], key
        assert received == []


def test_of_a_stop_and_a_request_to_arm_in_one_pass_the_stop_wins() -> None:
    with robot() as (bus, program, received):
        driver = program.driver()
        wait_until(lambda: driver.connected)
        assert bus._commands is not None
        bus._pollers[-2].close()  # the passes are made here
        stop, ask = program._session.put, program._session.get
        stop("omnid/cmd/stop", b"")
        reply = ask("omnid/@request/arm", payload=codec.header_cdr(time.time_ns()), timeout=5.0)
        time.sleep(0.5)
        bus._commands.process()
        assert [request.topic for request in received] == ["cmd/stop", "cmd/arm", "cmd/stop"]
        del reply


def test_large_requests_are_dropped_before_they_wait() -> None:
    with robot() as (_, program, received):
        for topic in sorted(REQUEST_TOPICS - {"cmd/path"}):
            with pytest.raises(OmnidError, match="has not answered"):
                program.driver().ask(topic, lambda _: bytes(20_000), timeout_s=0.2)
        assert received == []
        with pytest.raises(OmnidError, match="has not answered"):
            program.driver().ask("cmd/path", lambda _: bytes(20_000), timeout_s=0.2)
        assert [request.topic for request in received] == ["cmd/path"]


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


@pytest.mark.parametrize("payload", [b"", b"{}", b"[1]", b"null", b'{"done": 1}', b"\xff", b"[" * 100_000])
def test_what_is_no_answer_is_none(payload: bytes) -> None:
    assert answer_of(payload) is None
