"""zenoh sessions with the settings of the configuration."""

from __future__ import annotations

import time
from contextlib import ExitStack

import zenoh

from omnid.client import Robot
from omnid.transport.bus import BusConfig
from omnid.transport.session import open_session
from omnid.transport.topics import SERVED
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.waiting import wait_until


def test_queries_for_several_keys_at_once_are_all_answered() -> None:
    endpoint, keys = free_endpoint(), [f"omnid/{name}" for name in ("map", "tf_static", "status", *SERVED)]
    answered: list[str] = []
    with (
        open_session(BusConfig(listen=(endpoint,))) as daemon,
        Robot(connect=(endpoint,)) as program,
        ExitStack() as stack,
    ):
        for key in keys:
            stack.enter_context(daemon.declare_queryable(key, lambda query: query.reply(query.key_expr, b"")))
        wait_until(lambda: any(reply.ok for reply in program._session.get(keys[-1], timeout=5.0)))
        time.sleep(0.01)  # a second query for a key within 1 ms is refused
        for key in keys:
            program._session.get(key, lambda reply: answered.append(str(reply.ok.key_expr)), timeout=5.0)
        wait_until(lambda: sorted(answered) == sorted(keys))


def test_a_program_that_asks_in_a_loop_has_every_answer() -> None:
    endpoint = free_endpoint()
    with (
        open_session(BusConfig(listen=(endpoint,))) as daemon,
        Robot(connect=(endpoint,)) as program,
        daemon.declare_queryable("omnid/config", lambda query: query.reply(query.key_expr, b"here")),
    ):
        wait_until(lambda: program.query("config") == "here")
        assert [program.query("config") for _ in range(50)] == ["here"] * 50


def test_queries_of_a_link_are_bounded_before_they_reach_a_ring() -> None:
    """A listener in the place of the ring counts what zenoh lets through; another link is not in its way."""
    endpoint, count = free_endpoint(), [0]
    with (
        open_session(BusConfig(listen=(endpoint,))) as daemon,
        Robot(connect=(endpoint,)) as one,
        Robot(connect=(endpoint,)) as other,
    ):

        def take(query: zenoh.Query) -> None:
            count[0] += 1
            query.reply(query.key_expr, b"")

        key = "omnid/@request/arm"
        with daemon.declare_queryable(key, take):
            wait_until(lambda: any(reply.ok for reply in one._session.get(key, timeout=5.0)))
            before, begin_s = count[0], time.monotonic()
            for _ in range(3000):
                one._session.get(key, lambda _: None, timeout=1.0)
            wait_until(lambda: any(reply.ok for reply in other._session.get(key, timeout=5.0)))
            assert count[0] - before <= 1100 * (time.monotonic() - begin_s) + 2
