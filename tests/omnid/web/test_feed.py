"""The robot's messages on their way to the browsers, and the browsers that are sent them, without a program."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable

import numpy as np
import pytest
import zenoh

from calib import se3
from drivers.frame import Frame
from omnid.monitor.robot_state import Inbox, ReceivedMessage
from omnid.transport import codec, map_codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.image_codec import image_cdr
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from omnid.transport.scan_codec import scan_cdr
from omnid.transport.status_names import NAVIGATION, WHEELS, Key
from omnid.web import browsers as browsers_module
from omnid.web import feed as feed_module
from omnid.web.channels import Newest
from omnid.web.feed import RobotFeed
from omnid.web.snapshot import MOST_CELLS
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry

STATUS = codec.diagnostics_cdr(10**18, [DiagnosticStatus(WHEELS, 0, "armed", {Key.ARMED: "1"})])
MAP = map_codec.grid_cdr(10**18, "odom", np.full((4, 3), 100, np.int8), 0.1, (-1.0, -2.0))
SCAN = scan_cdr(10**9, "base_link", np.ones(360, np.float32), np.ones(360, np.float32), (0.1, 6.0))


def panorama(data: bytes) -> bytes:
    return bytes(image_cdr(Frame(1, 10**9, "lower", "jpeg", np.frombuffer(data, np.uint8)), 10**9)[1])


def add_pose(feed: RobotFeed, seq: int, resets: int = 0) -> None:
    """Put a pose at 0.25 m times seq into the inbox."""
    feed.inbox.put("odom", odometry(seq), PoseAttachment(seq, "tracking", resets, 50, 60, time.time_ns()).to_bytes())


def points(feed: RobotFeed) -> list[list[float]]:
    return list(json.loads(feed.path.message(0))["points"])


async def until(condition: Callable[[], object]) -> None:
    """Let the event loop go on until a condition holds."""
    end_s = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end_s
        await asyncio.sleep(0.001)


def test_a_message_is_refused_from_its_limit_on_and_the_newest_large_one_counts() -> None:
    async def check() -> None:
        feed = RobotFeed(BusConfig())
        receive = feed._receiver(asyncio.get_running_loop())
        limits = {
            "odom": 1 << 16,
            "map_pose": 1 << 16,
            "status": 1 << 20,
            "scan": 1 << 20,
            "map": MOST_CELLS + (1 << 16),
            "panorama": 1 << 23,
            "navigation": 1 << 16,
        }
        for broken, (topic, limit) in enumerate(limits.items(), 1):
            receive(topic, bytes(limit), b"")
            assert feed.state.broken == broken - 1, topic
            receive(topic, bytes(limit + 1), b"")
            assert feed.state.broken == broken, topic
        receive("elsewhere", b"", b"")
        receive("elsewhere", b"1", b"")
        assert feed.state.broken == len(limits) + 1
        assert set(feed._large) == {"scan", "map", "panorama", "navigation"}
        receive("scan", b"new", b"")
        assert feed._large["scan"] == b"new"
        taken = iter(lambda: feed.inbox.get(0.0), None)
        assert [message.topic for message in taken] == ["odom", "map_pose", "status", "elsewhere"]
        await asyncio.sleep(0)
        assert feed._wake.is_set() and feed._large_wake.is_set()

    asyncio.run(check())


def test_each_kind_of_message_wakes_its_own_task() -> None:
    async def check() -> None:
        for topic, large in (("odom", False), ("status", False), ("scan", True), ("map", True)):
            feed = RobotFeed(BusConfig())
            receive = feed._receiver(asyncio.get_running_loop())
            for _ in range(2):
                receive(topic, b"", b"")
            await asyncio.sleep(0)
            assert (feed._wake.is_set(), feed._large_wake.is_set()) == (not large, large)

    asyncio.run(check())


def test_the_path_begins_again_with_a_smaller_number_and_has_a_gap_after_a_reset() -> None:
    feed = RobotFeed(BusConfig())
    for seq, resets in ((5, 0), (6, 0), (6, 0), (7, 1), (8, 1)):
        add_pose(feed, seq, resets)
    feed._process_inbox()
    assert points(feed) == [[1.25, -1.0], [1.5, -1.0], [1.75, -1.0, 1], [2.0, -1.0]]
    assert len(feed._poses) == 5
    add_pose(feed, 1, 1)
    add_pose(feed, 2, 1)
    feed._process_inbox()
    assert points(feed) == [[0.25, -1.0], [0.5, -1.0]] and len(feed._poses) == 2


def test_a_robot_that_has_started_again_is_shown_without_what_belongs_to_its_odom_before() -> None:
    """The pages are sent messages without a map, obstacles, navigation and panorama, in place of the old ones."""
    feed = RobotFeed(BusConfig())
    navigation = DiagnosticStatus(NAVIGATION, 0, "", {str(Key.STATE): "driving", str(Key.TASK): "goal"})
    large = {
        "map": MAP,
        "scan": SCAN,
        "panorama": panorama(b"\xff\xd8 bytes"),
        "navigation": codec.diagnostics_cdr(10**18, [navigation]),
    }
    channels = (feed._map_channel, feed._scan_channel, feed._panorama_channel, feed._navigation_channel)

    async def take() -> None:
        for topic, payload in large.items():
            await feed._take_large(topic, payload)

    for seq in (4, 0):  # with nothing to forget there is nothing to send
        add_pose(feed, seq)
    feed._process_inbox()
    assert [channel.version for channel in channels] == [0, 0, 0, 0]
    add_pose(feed, 4)
    feed.inbox.put("map_pose", codec.pose_with_covariance_cdr(10**9 + 4, np.eye(4), np.eye(6)), b"")
    feed._process_inbox()
    asyncio.run(take())
    assert feed._map_in_odom is not None and [channel.version for channel in channels] == [1, 1, 1, 1]
    add_pose(feed, 0)
    feed._process_inbox()
    assert [channel.version for channel in channels] == [2, 2, 2, 2]
    assert json.loads(feed._encode_state())["map_in_odom"] is None
    no_map, no_panorama = (bytes(channel.message(1)[4:]) for channel in (feed._map_channel, feed._panorama_channel))
    assert json.loads(no_map) == {"type": "map", "width": 0, "height": 0, "frame": "odom"}
    assert json.loads(no_panorama) == {"type": "panorama", "stamp_ms": 0}
    assert json.loads(feed._scan_channel.message(1)) == {"type": "scan", "points": [], "nearest": None}
    report = json.loads(feed._navigation_channel.message(1))
    assert (report["state"], report["task"], report["left_m"]) == ("", "", None)


def test_a_status_makes_new_parts_and_a_daemon_that_has_ended_takes_them_along() -> None:
    feed = RobotFeed(BusConfig())
    add_pose(feed, 1)
    feed._process_inbox()
    assert feed._parts_channel.version == 0
    feed.inbox.put("status", STATUS, b"")
    feed._process_inbox()
    assert feed._parts_channel.version == 1 and WHEELS in feed.state.statuses
    for alive in (None, True):
        feed.state.alive = alive
        feed._forget_ended()
        assert feed.state.statuses
    feed.state.alive = False
    feed._forget_ended()
    assert not feed.state.statuses and feed._parts_channel.version == 2
    feed._forget_ended()
    assert feed._parts_channel.version == 2
    feed.inbox.put("map_pose", b"nonsense", b"")
    feed._process_inbox()
    assert feed.state.broken == 1


def test_the_place_of_the_map_is_kept_until_another_is_known() -> None:
    feed = RobotFeed(BusConfig())
    add_pose(feed, 4)  # at 1 m, -1 m, stamped 10**9 + 4

    def map_pose(stamp_ns: int, x_m: float) -> list[float | None] | None:
        T = se3.transform(se3.rotation_exp([0.0, 0.0, 0.4]), [x_m, 0.0, 0.0])
        feed.inbox.put("map_pose", codec.pose_with_covariance_cdr(stamp_ns, T, np.eye(6)), b"")
        feed._process_inbox()
        return feed._map_in_odom

    assert map_pose(10**9 + 5, 0.0) is None
    assert map_pose(10**9 + 4, 0.25) == pytest.approx([0.75, -1.0, 0.0], abs=1e-6)
    assert map_pose(10**9 + 5, 7.0) == pytest.approx([0.75, -1.0, 0.0], abs=1e-6)
    assert map_pose(10**9 + 4, 0.5) == pytest.approx([0.5, -1.0, 0.0], abs=1e-6)
    assert json.loads(feed._encode_state())["map_in_odom"] == feed._map_in_odom


def test_the_event_loop_never_waits_for_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    feed, waits_s, get = RobotFeed(BusConfig()), set[float](), Inbox.get

    def recorded(inbox: Inbox, timeout_s: float) -> ReceivedMessage | None:
        waits_s.add(timeout_s)
        return get(inbox, 0.0)

    monkeypatch.setattr(Inbox, "get", recorded)
    add_pose(feed, 1)
    feed._process_inbox()
    assert waits_s == {0.0} and feed.state.poses == 1


def test_large_messages_reach_their_channels_and_wrong_ones_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    feed = RobotFeed(BusConfig())
    navigation = DiagnosticStatus(NAVIGATION, 0, "", {str(Key.STATE): "driving", str(Key.REASON): ""})
    jpeg = panorama(b"\xff\xd8\xff\xe0 bytes")
    channels = (feed._scan_channel, feed._navigation_channel, feed._map_channel, feed._panorama_channel)

    async def take(*taken: tuple[str, bytes]) -> tuple[int, ...]:
        for topic, payload in taken:
            await feed._take_large(topic, payload)
        return tuple(channel.version for channel in channels)

    report = codec.diagnostics_cdr(10**18, [navigation])
    good = (("scan", SCAN), ("navigation", report), ("map", MAP), ("panorama", jpeg))
    for count, one in enumerate(good, 1):
        assert asyncio.run(take(one)) == tuple([1] * count + [0] * (4 - count))
    message = feed._panorama_channel.message(0)
    assert isinstance(message, bytes)
    header, _, body = message[4:].partition(b"}")
    assert json.loads(header + b"}") == {"type": "panorama", "stamp_ms": 1000} and body == b"\xff\xd8\xff\xe0 bytes"
    assert feed.state.broken == 0
    # A panorama too soon after another is left out, one that is no JPEG is refused.
    monkeypatch.setattr(feed_module, "PANORAMA_S", 1000.0)
    assert asyncio.run(take(("panorama", jpeg)))[3] == 1
    monkeypatch.setattr(feed_module, "PANORAMA_S", 0.0)
    assert asyncio.run(take(("panorama", jpeg)))[3] == 2
    assert asyncio.run(take(("panorama", panorama(b"GIF89a")), ("scan", b"x"), ("map", b"x")))[3] == 2
    assert feed.state.broken == 3


def test_the_state_counts_browsers_and_panoramas() -> None:
    feed = RobotFeed(BusConfig(robot="rover"))
    feed.inbox.dropped = 3
    feed._panorama_channel.changed()
    message = json.loads(feed._encode_state())
    assert message["robot"] == "rover" and message["link"] == "not connected yet"
    assert (message["dropped"], message["browsers"], message["panoramas"]) == (3, 0, 1)
    assert feed._panorama_s == -feed_module.PANORAMA_S, "the first panorama after the start of the machine counts"


@pytest.mark.parametrize("has_map", [True, False])
def test_it_follows_a_robot_from_what_was_published_before(monkeypatch: pytest.MonkeyPatch, has_map: bool) -> None:
    monkeypatch.setattr(feed_module, "REQUEST_S", 0.001)
    monkeypatch.setattr(feed_module, "QUIET_S", 0.02)
    endpoint = free_endpoint()

    async def check(bus: Bus) -> RobotFeed:
        bus.publish("status", STATUS)
        if has_map:
            bus.publish("map", MAP)
        feed = RobotFeed(BusConfig(connect=(endpoint,)))
        following = asyncio.create_task(feed.run())
        await until(lambda: feed._map_channel.version if has_map else feed._parts_channel.version)
        assert not feed.link and WHEELS in feed.state.statuses and feed._parts_channel.version
        await until(lambda: feed.state.alive)
        shown = feed._state_channel.version
        await until(lambda: feed._state_channel.version > shown + 1)  # without a message
        # A panorama is subscribed to while a browser asks for it.
        browser = browsers_module._Browser([])
        feed.browsers._open.add(browser)
        assert not bus.is_received("panorama")
        browser.wanted.add("panorama")
        await until(lambda: bus.is_received("panorama"))
        bus.publish("panorama", panorama(b"\xff\xd8 bytes"))
        await until(lambda: feed._panorama_channel.version)
        end = feed._end_panorama
        assert end is not None and feed.robot is not None
        await feed._follow_requests(feed.robot, feed._receiver(asyncio.get_running_loop()))
        assert feed._end_panorama is end, "it goes on while it is asked for"
        browser.wanted.clear()
        await until(lambda: not bus.is_received("panorama"))
        assert feed._end_panorama is None
        bus.publish("scan", SCAN)
        await until(lambda: feed._scan_channel.version)
        following.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await following
        return feed

    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        feed = asyncio.run(check(bus))
    assert feed.robot is not None
    with pytest.raises(zenoh.ZError):
        feed.robot.driver()  # the connection is closed


def channels(*names: str) -> list[Newest]:
    """Return channels whose messages are their names and versions."""
    found = [Newest(name, lambda: "") for name in names]
    for channel in found:
        channel._encode = lambda channel=channel: f"{channel.name} {channel.version}"  # type: ignore[misc]
    return found
