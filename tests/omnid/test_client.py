"""The client: what the examples in its words say is so."""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from itertools import count

import numpy as np
import pytest

import omnid.client
from calib import se3
from omnid.client import Answer, Driver, Robot, subscribe
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import PoseAttachment
from omnid.transport.commands import Freshness
from omnid.transport.topics import Request
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry, script
from tests.waiting import wait_until


@contextlib.contextmanager
def robot() -> Iterator[tuple[Bus, str]]:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        yield bus, endpoint


def test_keeps_only_the_newest_pose() -> None:
    with robot() as (bus, endpoint), subscribe(connect=endpoint) as poses:
        assert poses.newest() is None and poses.wait(0.05) is None
        numbers = count()
        wait_until(lambda: bus.publish("odom", odometry(next(numbers))) is None and poses.newest() is not None)

        def only_the_last_of_ten_is_read(first: int) -> bool:
            for i in range(first, first + 10):
                bus.publish("odom", odometry(i))
            time.sleep(0.3)
            pose = poses.newest()
            return pose is not None and pose.stamp_ns == 10**9 + first + 9 and poses.newest() is None

        # A busy machine may take longer to deliver: then ten others are sent.
        wait_until(lambda: only_the_last_of_ten_is_read(1000 + 10 * next(numbers)))


def test_imports_nothing_that_only_the_daemon_needs() -> None:
    words = [sys.executable, "-c", "import omnid.client, sys; print(*sys.modules)"]
    modules = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
    assert not {"cv2", "serial", "filterpy", "mcap", "scipy"} & set(modules) and "zenoh" in modules


def example(text: str | None) -> str:
    """Return the code in a docstring: its indented part."""
    lines = textwrap.dedent((text or "").split("\n", 1)[1]).splitlines()
    return textwrap.dedent("\n".join(line for line in lines if line.startswith("    "))) + "\n"


def test_the_subscriber_example_prints_poses() -> None:
    with robot() as (bus, endpoint):
        code = example(omnid.client.__doc__).replace('("omnid")', f'("omnid", connect=("{endpoint}",))')
        assert 5 <= len(code.strip().splitlines()) <= 10
        with script(f"print('ready', flush=True)\n{code}") as process:
            numbers = count()
            attachment = PoseAttachment(1, "tracking").to_bytes()
            wait_until(
                lambda: bus.publish("odom", odometry(next(numbers)), attachment) is None and process.poll() is not None
            )
            assert process.returncode == 0 and process.stdout is not None
            assert process.stdout.read().startswith("tracking: ")


def test_the_waypoint_example_drives_a_robot_to_the_last_waypoint() -> None:
    """The robot is simulated: its odometry follows the commands."""
    state = {"x": 0.0, "y": 0.0}
    stops: list[str] = []

    def execute(request: Request) -> None:
        if request.topic == "cmd/arm":
            bus.answer(request.id, Answer(True, "armed"))
        elif request.topic == "cmd/heading":
            _, _, velocity_mps, heading_rad = codec.heading_from_cdr(request.payload)
            state["x"] += 0.1 * velocity_mps * math.cos(heading_rad)
            state["y"] += 0.1 * velocity_mps * math.sin(heading_rad)
        elif request.topic == "cmd/twist":
            stops.append(request.topic)

    with robot() as (bus, endpoint):
        bus.subscribe_commands(execute, {})
        code = example(Driver.__doc__).replace('Robot("omnid")', f'Robot("omnid", connect=("{endpoint}",))')
        with script(f"print('ready', flush=True)\n{code}") as process:

            def run() -> bool:
                T = se3.transform(np.eye(3), [state["x"], state["y"], 0.0])
                bus.publish(
                    "odom",
                    codec.odometry_cdr(time.time_ns(), T, np.eye(6), np.zeros(6), np.eye(6)),
                    PoseAttachment(1, "tracking").to_bytes(),
                )
                return process.poll() is not None

            wait_until(run, pause_s=0.005)
            assert process.returncode == 0
        wait_until(lambda: bool(stops))
    assert math.hypot(state["x"] - 1.0, state["y"] - 1.0) < 0.15


def test_sends_commands() -> None:
    received: list[Request] = []
    freshness = Freshness(60.0)
    with robot() as (bus, endpoint), Robot(connect=(endpoint,)) as connection:
        bus.serve("time", freshness.own_time)
        driver = connection.driver()
        assert not driver.connected
        bus.subscribe_commands(received.append, {})
        wait_until(lambda: driver.connected)
        driver.twist(0.5, -0.25)
        driver.heading(0.75, 1.5)
        wait_until(lambda: len(received) == 2)
        driver.stop()
        wait_until(lambda: len(received) == 3)
        before_ns = time.time_ns()
        with pytest.raises(OmnidError, match="has not answered"):
            driver.arm(timeout_s=0.2)
        wait_until(lambda: len(received) == 4)
        connection.driver("planner").twist(0.5, -0.25)
        wait_until(lambda: len(received) == 5)
        with Robot(connect=(endpoint,)) as other:
            other.driver().stop()
            wait_until(lambda: len(received) == 6)
    received[:2] = sorted(received[:2], reverse=True)  # the order of different topics is not kept
    (twist, a, *_), (heading, b, *_), (stop, *_), (arm, c, _, sent_ns, *_), (planned, d, *_), _ = received
    assert (twist, heading, stop, arm) == ("cmd/twist", "cmd/heading", "cmd/stop", "cmd/arm")
    assert planned == "cmd/planner/twist" and codec.twist_from_cdr(d)[1:4] == ("base_link", 0.5, -0.25)
    assert (
        codec.header_stamp_ns(codec.decoded(c, codec.HEADER_SCHEMA)) == sent_ns
        and before_ns <= sent_ns <= time.time_ns()
    )
    senders = [request.sender for request in received]
    assert len({senders[0], senders[1], senders[2], senders[4]}) == 1 and senders[5] != senders[0]
    assert all(len(sender) >= 16 for sender in senders)
    assert codec.twist_from_cdr(a)[1:4] == ("base_link", 0.5, -0.25)
    assert codec.heading_from_cdr(b)[1:] == ("odom", 0.75, 1.5)
    # Each says when it was sent by the robot's own time, whatever the clock of this computer.
    for request in received:
        freshness.require(Request(request.topic, echo_ns=request.echo_ns), time.monotonic_ns())
    assert [r.echo_ns for r in received[2:]] == sorted(r.echo_ns for r in received[2:])
