"""Stops for all robots, the table of the fleet and the pages of single robots, with a router in the same process."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from types import SimpleNamespace

import pytest
import zenoh

from omnid.client import Fleet
from omnid.errors import OmnidError
from omnid.monitor.fleet import MAX_ROBOTS
from omnid.monitor.robot_state import Inbox, ReceivedMessage, RobotState
from omnid.transport import codec, session
from omnid.transport.bus import BusConfig
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import BUS, DISARMED_BY_STOP, WHEELS
from omnid.web import fleet_feed, fleet_page
from omnid.web.access import Access
from omnid.web.fleet_feed import FleetFeed, robot_key
from omnid.web.fleet_page import MOST_OPEN, FleetPage
from omnid.web.site import Site
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry
from tests.waiting import wait_until

ARMED = DiagnosticStatus(WHEELS, 0, "armed", {"armed": "1"})
STOPPED = DiagnosticStatus(WHEELS, 1, "stopped", {"armed": "0", "disarmed_by": DISARMED_BY_STOP})
STOP_S = 1000.0
FAULT = DiagnosticStatus(WHEELS, 2, "a fault", {"armed": "0", "disarmed_by": "a fault"})


class Router:
    """A router, and the stops that robots behind it get."""

    def __init__(self, endpoint: str) -> None:
        config = zenoh.Config()
        for name, value in (
            ("mode", '"router"'),
            ("listen/endpoints", json.dumps([endpoint])),
            ("scouting/multicast/enabled", "false"),
            ("open/return_conditions/connect_scouted", "false"),
        ):
            config.insert_json5(name, value)
        self.session, self.endpoint = zenoh.open(config), endpoint
        self.stops: Counter[str] = Counter()
        self.on_stop: Callable[[str], None] = lambda _: None
        self._subscriber = self.session.declare_subscriber("**/cmd/stop", self._count)

    def _count(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).removesuffix("/cmd/stop")
        self.stops[name] += 1
        self.on_stop(name)


@pytest.fixture(scope="module")
def opened() -> Iterator[Router]:
    found = Router(free_endpoint())
    with found.session:
        yield found


@pytest.fixture
def router(opened: Router, monkeypatch: pytest.MonkeyPatch) -> Router:
    opened.stops.clear()
    opened.on_stop = lambda _: None
    monkeypatch.setattr(fleet_feed, "REPEAT_S", 0.03)
    return opened


@pytest.fixture
def feed(router: Router) -> Iterator[FleetFeed]:
    found = FleetFeed(BusConfig(connect=(router.endpoint,)))
    with Fleet(BusConfig(connect=(router.endpoint,)), timeout_s=30.0) as found._fleet:
        yield found


def report(feed: FleetFeed, name: str, *statuses: DiagnosticStatus) -> None:
    """Put a status of a robot into the table."""
    message = ReceivedMessage(time.time_ns(), f"{name}/status", codec.diagnostics_cdr(10**18, statuses), b"")
    feed.state.process(message)


def pose(feed: FleetFeed, name: str, seq: int, received_ns: int) -> None:
    attachment = PoseAttachment(seq, "tracking", 0, 50, 60, received_ns).to_bytes()
    feed.state.process(ReceivedMessage(received_ns, f"{name}/odom", odometry(seq), attachment))


def test_a_stop_for_all_ends_once_each_robot_with_wheels_confirms_it(router: Router, feed: FleetFeed) -> None:
    report(feed, "quick", ARMED)
    report(feed, "slow", STOPPED)  # of an earlier stop: it may have been armed since
    report(feed, "camera", DiagnosticStatus(BUS, 0, "open", {}))
    report(feed, "gone", ARMED)
    feed.state.robots["gone"].set_alive(False)
    unknown = feed.state.robot("unknown")  # its token is there, no status yet: it may have wheels
    assert unknown is not None
    unknown.set_alive(True)

    def confirm(name: str) -> None:
        if name == "quick" or router.stops[name] == 3:
            report(feed, name, FAULT if name == "quick" and router.stops[name] == 1 else STOPPED)

    router.on_stop = confirm
    assert feed.stops == 0
    answer = asyncio.run(feed.stop_all())
    assert (answer.done, answer.text) == (True, "all 3 robots stop: their wheels stand until they are armed")
    assert feed.stops == 1 and set(router.stops) == {"quick", "slow", "unknown", "camera"}
    assert router.stops["camera"] == 1, "once, in case"
    assert router.stops["slow"] >= 3 and router.stops["unknown"] >= 3 and router.stops["quick"] >= 2


@pytest.mark.parametrize(("count", "more"), [(1, ""), (10, ""), (11, " and 1 others"), (13, " and 3 others")])
def test_robots_that_do_not_confirm_are_named(
    router: Router, feed: FleetFeed, count: int, more: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"r{number:02}\x1b" for number in range(count)]
    for name in (*names, "good"):
        report(feed, name, ARMED)
    router.on_stop = lambda name: report(feed, name, STOPPED if name == "good" else FAULT)
    ready = list[float]()

    def clock_s() -> float:
        """Return the time, which is over some looks after each robot got two stops."""
        if router.stops["good"] and all(router.stops[name] > 1 for name in names):
            ready.append(time.monotonic())
        return time.monotonic() + (STOP_S if len(ready) > 5 else 0.0)

    monkeypatch.setattr(fleet_feed, "STOP_S", STOP_S)
    monkeypatch.setattr(fleet_feed, "time", SimpleNamespace(monotonic=clock_s, time_ns=time.time_ns))
    answer = asyncio.run(feed.stop_all())
    named = ", ".join(rf"r{number:02}\x1b" for number in range(min(count, 10)))
    assert not answer.done
    assert answer.text == (f"NOT confirmed by {named}{more}: use the emergency stop. 1 of {count + 1} robots stop")
    assert all(router.stops[name] > 1 for name in names)


def test_where_no_robot_has_wheels_each_gets_one_stop_and_none_is_reported(router: Router, feed: FleetFeed) -> None:
    report(feed, "camera", DiagnosticStatus(BUS, 0, "open", {}))
    answer = asyncio.run(feed.stop_all())
    assert (answer.done, answer.text) == (False, "no robot with wheels is there")
    wait_until(lambda: router.stops == {"camera": 1})


def test_without_a_connection_no_stop_is_sent() -> None:
    feed = FleetFeed(BusConfig())
    answer = asyncio.run(feed.stop_all())
    assert not answer.done and feed.stops == 1
    assert answer.text == ("no stop is sent: use the emergency stops. There is no connection: not connected yet")


def test_the_table_has_the_worst_robots_first_and_their_numbers() -> None:
    feed, now_ns = FleetFeed(BusConfig()), time.time_ns()
    for name in ("b", "a", "worst"):
        for seq in range(1, 4):
            pose(feed, name, seq, now_ns - 10**8 * (3 - seq))
    report(feed, "worst", FAULT)
    report(feed, "b", DiagnosticStatus(BUS, 0, "open", {}), dataclasses.replace(STOPPED, level=0))
    report(feed, "a", ARMED)
    report(feed, "silent", ARMED)
    pose(feed, "silent", 1, now_ns - 7 * 10**9)
    feed.state.robots["silent"].set_alive(False)
    feed.state.refused.add("one more")
    feed.inbox.dropped, feed.link = 3, "no\x1b way"
    message = json.loads(feed._encode())
    assert message["type"] == "fleet" and message["link"] == r"no\x1b way"
    assert (message["refused"], message["dropped"]) == (1, 3)
    rows = {row["name"]: row for row in message["robots"]}
    assert list(rows) == ["silent", "worst", "a", "b"]
    assert [row["level"] for row in rows.values()] == [2, 2, 0, 0]
    assert [row["armed"] for row in rows.values()] == [None, False, True, False]
    assert [row["state"] for row in rows.values()] == ["gone", "tracking", "tracking", "tracking"]
    assert [row["silent_s"] for row in rows.values()] == [7, 0, 0, 0]
    assert [row["problem"] for row in rows.values()] == ["", "wheels: a fault", "", ""]
    assert rows["a"]["rate_hz"] == pytest.approx(10.0, abs=1e-3)
    assert (rows["a"]["x_m"], rows["a"]["y_m"]) == (0.75, -1.0) and rows["a"]["yaw_rad"] == pytest.approx(0.3)
    assert {feed.name_of(row["key"]) for row in rows.values()} == set(rows) and feed.name_of("0") is None
    feed.state.robots["new"] = RobotState()
    row = next(row for row in json.loads(feed._encode())["robots"] if row["name"] == "new")
    assert [row[key] for key in ("x_m", "y_m", "yaw_rad", "armed", "silent_s")] == [None] * 5


def test_messages_are_taken_in_groups_and_tokens_before_them() -> None:
    feed = FleetFeed(BusConfig())
    payload = codec.diagnostics_cdr(10**18, [ARMED])
    for number in range(450):
        feed.inbox.put(f"r{number % 3}/status", payload, b"")
    for name, alive in (("r0", False), ("r1", True), *((f"other {k}", True) for k in range(MAX_ROBOTS))):
        feed.state.note_alive(name, alive)
    assert [feed._take() for _ in range(4)] == [200, 200, 50, 0]
    assert [feed.state.robots[name].alive for name in ("r0", "r1", "other 0")] == [False, True, True]
    assert len(feed.state.robots) == MAX_ROBOTS


def test_a_flood_delays_neither_stops_nor_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = FleetFeed(BusConfig())
    payload = codec.diagnostics_cdr(10**18, [ARMED])
    for number in range(450):
        feed.inbox.put(f"r{number % 3}/status", payload, b"")
    waits_s, pauses_s, get = set[float](), list[float](), Inbox.get

    def recorded_get(inbox: Inbox, timeout_s: float) -> ReceivedMessage | None:
        waits_s.add(timeout_s)
        return get(inbox, 0.0)

    async def recorded_sleep(pause_s: float) -> None:
        pauses_s.append(pause_s)
        if len(pauses_s) == 4:
            raise asyncio.CancelledError

    with monkeypatch.context() as patched:
        patched.setattr(Inbox, "get", recorded_get)
        patched.setattr(asyncio, "sleep", recorded_sleep)
        patched.setattr(fleet_feed, "SHOW_S", 1000.0)
        with pytest.raises(asyncio.CancelledError):
            asyncio.run(feed._process())
    assert waits_s == {0.0}, "the event loop, which sends stops, never waits for a message"
    assert pauses_s == [0.0, 0.0, fleet_feed._POLL_S, fleet_feed._POLL_S]
    assert feed._channel.version == 1, "the table is sent at its period only"


def test_the_feed_follows_as_soon_as_there_is_a_router(router: Router, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_feed, "_RETRY_S", 0.01)
    monkeypatch.setattr(session, "_CONNECT_TIMEOUT_MS", 50)
    monkeypatch.setattr(fleet_feed, "SHOW_S", 0.02)
    feed = FleetFeed(BusConfig(connect=(free_endpoint(),)))
    assert feed.link == "not connected yet"

    async def follow() -> None:
        following = asyncio.create_task(feed.run())
        await _until(lambda: "cannot reach" in feed.link)
        feed._bus = BusConfig(connect=(router.endpoint,))
        await _until(lambda: not feed.link)
        payload = codec.diagnostics_cdr(10**18, [ARMED])
        token = router.session.liveliness().declare_token("hall/one/alive")

        def is_known() -> bool:
            router.session.put("hall/one/status", payload)
            state = feed.state.robots.get("hall/one")
            return state is not None and bool(state.alive) and WHEELS in state.statuses

        await _until(is_known)
        token.undeclare()  # type: ignore[no-untyped-call]
        await _until(lambda: feed.state.robots["hall/one"].alive is False)
        shown = feed._channel.version
        await _until(lambda: feed._channel.version > shown)
        following.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await following

    asyncio.run(follow())
    assert feed._fleet is not None
    with pytest.raises(zenoh.ZError):
        feed._fleet.stop("hall/one")  # the connection is closed


async def _until(condition: Callable[[], bool]) -> None:
    """Wait for a condition without blocking the event loop."""
    await asyncio.to_thread(wait_until, condition, 0.002)


@contextlib.asynccontextmanager
async def pages(count: int, settings: BusConfig) -> AsyncIterator[tuple[FleetPage, list[str]]]:
    """Yield the pages of a fleet of robots, and the robots' keys."""
    feed = FleetFeed(settings)
    names = [f"robot_{number}" for number in range(count)]
    for name in names:
        feed.state.robot(name)
    page = FleetPage(feed, settings)
    try:
        yield page, [robot_key(name) for name in names]
    finally:
        for key in list(page._open):
            await page._close(key)


def test_only_so_many_robots_are_open_and_the_one_not_used_for_longest_goes(router: Router) -> None:
    async def check() -> None:
        async with pages(MOST_OPEN + 2, BusConfig(connect=(router.endpoint,))) as (page, keys):
            with pytest.raises(OmnidError, match="not been seen"):
                page._opened("0")
            opened = [page._opened(key) for key in keys[:MOST_OPEN]]
            assert [one.page.feed.bus.robot for one in opened] == [f"robot_{k}" for k in range(MOST_OPEN)]
            assert page._opened(keys[0]) is opened[0] and list(page._open) == keys[:MOST_OPEN]
            assert not any(one.busy for one in opened)
            for order, one in enumerate(opened):
                one.used_s = 1000.0 - order
            oldest = opened[-1]
            # The one used longest ago shows a page, the next waits for the confirmation of a stop: both stay.
            oldest.page.feed.browsers._open.add(object())  # type: ignore[arg-type]
            stopping = asyncio.Event()
            opened[-2].page.wheels._stopping = asyncio.create_task(stopping.wait())  # type: ignore[arg-type]
            assert oldest.busy and opened[-2].busy
            page._opened(keys[MOST_OPEN])
            assert set(page._open) == {*keys[: MOST_OPEN - 3], *keys[MOST_OPEN - 2 : MOST_OPEN + 1]}
            assert len(page._open) == MOST_OPEN
            with contextlib.suppress(asyncio.CancelledError):
                await opened[-3].following
            assert opened[-3].following.cancelled() and not oldest.following.done()
            # Where all are in use, no more are opened; those that are open are answered.
            for one in page._open.values():
                one.page.feed.browsers._open.add(object())  # type: ignore[arg-type]
            with pytest.raises(OmnidError, match=f"the pages of {MOST_OPEN} robots"):
                page._opened(keys[-1])
            assert page._opened(keys[0]) is opened[0]
            stopping.set()

    asyncio.run(check())


def test_a_page_is_closed_when_it_is_not_used_or_cannot_follow(router: Router, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_page, "_CHECK_S", 0.01)

    async def check() -> None:
        async with pages(4, BusConfig(connect=(router.endpoint,))) as (page, keys):
            used, shown, unused, ended = [page._opened(key) for key in keys]
            shown.page.feed.browsers._open.add(object())  # type: ignore[arg-type]
            shown.used_s = unused.used_s = time.monotonic() - fleet_page.UNUSED_S - 1.0
            used.used_s = time.monotonic() - fleet_page.UNUSED_S + 50.0
            before_s = time.monotonic()
            ended.following.cancel()
            closing = asyncio.create_task(page._close_unused())
            while len(page._open) > 2:
                await asyncio.sleep(0)
            while shown.used_s < before_s:
                await asyncio.sleep(0)
            closing.cancel()
            assert set(page._open) == set(keys[:2])
            assert unused.following.cancelled() and not used.following.done()

    asyncio.run(check())


def test_requests_about_robots_that_were_not_seen_are_refused_in_the_words_of_each_kind(router: Router) -> None:
    sent: list[dict[str, object]] = []

    async def send(message: object) -> None:
        assert isinstance(message, dict)
        sent.append(message)

    async def receive() -> dict[str, object]:
        if sent:  # the browser stays
            await asyncio.Event().wait()
        return {"type": "websocket.connect"}

    async def check() -> None:
        async with pages(1, BusConfig(connect=(router.endpoint,))) as (page, keys):
            base = {"path": "/", "root_path": "", "query_string": b"", "headers": []}
            for key, scope in (
                ("0", {"type": "websocket"}),
                ("0", {"type": "http", "method": "GET"}),
                ("0", {"type": "http", "method": "POST"}),
                (keys[0], {"type": "http", "method": "GET"}),
            ):
                before_s = time.monotonic()
                await page._robot({**base, **scope, "path_params": {"key": key}}, receive, send)
            assert list(page._open) == keys and page._open[keys[0]].used_s >= before_s

    asyncio.run(check())
    assert sent[0]["code"] == 1013 and "not been seen" in str(sent[0]["reason"])
    statuses = [message["status"] for message in sent if message["type"] == "http.response.start"]
    bodies = [bytes(message["body"]) for message in sent if message["type"] == "http.response.body"]  # type: ignore[call-overload]
    assert statuses == [404, 409, 200]
    assert bodies[0].startswith(b"omnid web: this robot") and b'"done":false' in bodies[1]


def test_the_metrics_of_a_fleet_count_stops_and_name_robots() -> None:
    feed = FleetFeed(BusConfig())
    report(feed, "one", FAULT)
    for name, alive in (("one", True), ("two", False), ("three", None)):
        state = feed.state.robot(name)
        assert state is not None
        state.alive = alive
    feed.stops, feed.inbox.dropped = 4, 5
    access = Access("abcdefghijklmnop", frozenset(), False, "omnid_1", "")
    lines = FleetPage(feed, BusConfig()).metrics(Site("fleet.html", [], lambda _: "", access, False).guard).splitlines()
    for line in (
        'omnid_up{robot="one"} 1',
        'omnid_up{robot="two"} 0',
        'omnid_up{robot="three"} 0',
        'omnid_status_level{robot="one",part="wheels"} 2',
        "omnid_web_dropped_total 5",
        "omnid_web_stops_total 4",
        "omnid_web_arms_total 0",
    ):
        assert line in lines
