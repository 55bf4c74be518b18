"""Messages of the stages as those of ROS 2, on the bus, and to the controller."""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from struct import unpack_from
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from calib import se3
from omnid.client import Robot
from omnid.core.control.arming import PLANNER, TimedSetpoint
from omnid.core.control.heading_controller import Setpoint
from omnid.core.mapping.voxel_map import MapPoints
from omnid.core.navigation.requests import NavigationState
from omnid.core.odometry.stereo_frame import Features
from omnid.core.types.panorama import PaddedPanorama
from omnid.messages import MapUpdate, NavigationUpdate, OdometryUpdate, RequestAnswer
from omnid.sinks.drive import LiveDrive, navigation_answers
from omnid.sinks.encoder import CLOUD_POINTS, BusSink, Encoder, Outgoing, PanoramaSink
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import PlanarPath, decode_pose
from omnid.transport.topics import PUBLISHED, Answer
from tests.omnid.transport.bus_fixtures import free_endpoint
from tests.simulation import make_rig
from tests.waiting import wait_until

OFFSET_NS = 10**18


def unix_ns(stamp_ns: int) -> int:
    return stamp_ns + OFFSET_NS


RIG = replace(make_rig(size=256), T_base_rig=np.eye(4))
IMAGE = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (64, 160), np.uint8), (0, 0), 4)


def odometry(seq: int) -> OdometryUpdate:
    T = se3.transform(np.eye(3), [1.0, 0.0, 0.0])
    depth = cast("Any", SimpleNamespace(panoramas=SimpleNamespace(lower=PaddedPanorama(IMAGE, 16), motion=())))
    features = Features(np.array([[3.4, 5.0], [7.0, 8.6]]), np.array([[1.0, 2.0]]))
    return OdometryUpdate(seq, 10**9 * seq, T, np.eye(6), np.zeros(6), np.eye(6), "degraded", 3, 5, 9, depth, features)


def test_a_pose_comes_with_its_state_and_the_frames_of_ros() -> None:
    endpoint, came = free_endpoint(), {}
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as robot:
        sink = BusSink(bus, Encoder(RIG, 6.0, unix_ns, "run"))
        robot.on_message(lambda topic, payload, note: came.update({topic: (payload, note)}))
        wait_until(lambda: sink.process(odometry(2)) is None and {"odom", "pose", "tf"} <= came.keys())
    pose = decode_pose(*came["odom"])
    assert pose.stamp_ns == OFFSET_NS + 2 * 10**9 and pose.x_m == 1.0
    note = pose.attachment
    assert (note.seq, note.state, note.resets, note.inliers, note.tracked) == (2, "degraded", 3, 5, 9)
    assert 0 <= time.time_ns() - note.sent_ns < 60 * 10**9
    tf = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(came["tf"][0], "tf2_msgs/msg/TFMessage")
    frames = [(edge.header.frame_id, edge.child_frame_id) for edge in cast("Any", tf).transforms]
    assert frames == [("odom", "base_link")]


@pytest.mark.parametrize("gives_time", [False, True])
def test_a_run_with_a_time_of_its_own_publishes_it_and_never_back(gives_time: bool) -> None:
    endpoint = free_endpoint()
    came: list[tuple[str, bytes]] = []
    bus = Bus(BusConfig(listen=(endpoint,)), gives_time=gives_time)
    with contextlib.closing(bus), Robot(connect=(endpoint,)) as robot:
        sink = BusSink(bus, Encoder(RIG, 6.0, unix_ns, "run"), gives_time=gives_time)
        robot.on_message(lambda topic, payload, _: came.append((topic, payload)))
        wait_until(lambda: sink.process(odometry(len(came) + 2)) is None and any(topic == "odom" for topic, _ in came))
        newest = len(came) + 100
        for seq in (newest, newest - 50, newest + 1):  # a log may step back
            sink.process(odometry(seq))
        # Poses of the wait above may still be on their way, so the last one is known by its stamp.
        last = OFFSET_NS // 10**9 + newest + 1
        wait_until(lambda: any(topic == "odom" and unpack_from("<i", data, 4)[0] == last for topic, data in came))
        wait_until(lambda: not gives_time or times_of(came)[-1:] == [last])
    assert bool(times_of(came)) == gives_time and times_of(came) == sorted(set(times_of(came)))


def times_of(came: list[tuple[str, bytes]]) -> list[int]:
    """Return the seconds of the clock messages."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    clocks = [store.deserialize_cdr(data, "rosgraph_msgs/msg/Clock") for topic, data in list(came) if topic == "clock"]
    return [cast("Any", clock).clock.sec for clock in clocks]


def panorama(payload: bytes) -> Any:
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(payload, "sensor_msgs/msg/CompressedImage")


def stamp_s(payload: bytes) -> int:
    """Return the stamp of a panorama after the offset."""
    return int(panorama(payload).header.stamp.sec) - 10**9


def test_panoramas_are_published_at_the_configured_rate() -> None:
    endpoint, came = free_endpoint(), []
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, Robot(connect=(endpoint,)) as robot:
        robot.on_message(lambda topic, payload, note: came.append((payload, note)))
        wait_until(lambda: PanoramaSink(bus, 0.5, unix_ns).process(odometry(0)) is None and bool(came))
        sink = PanoramaSink(bus, 0.5, unix_ns)
        for seq in range(100, 107):  # a second apart, later than those above
            sink.process(odometry(seq))
        wait_until(lambda: bool(came) and stamp_s(came[-1][0]) >= 106)
    messages = [panorama(payload) for payload, _ in came if stamp_s(payload) >= 100]
    assert [message.header.stamp.sec - 10**9 for message in messages] == [100, 102, 104, 106]
    shown = cv2.imdecode(messages[0].data, cv2.IMREAD_GRAYSCALE)
    assert shown.shape == (64, 128) and np.abs(shown.astype(int) - IMAGE[:, 16:-16]).max() < 20


def test_a_late_subscriber_gets_the_path_of_the_drive() -> None:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        sink = BusSink(
            bus, Encoder(replace(RIG, T_base_rig=se3.transform(np.eye(3), [0.2, 0.0, 1.0])), 6.0, run_id="run")
        )
        for k in range(101):
            T = se3.transform(np.eye(3), [0.01 * k, 0.0, 0.0])
            sink.process(replace(odometry(k), T_odom_rig=T))
        with Robot(connect=(endpoint,)) as robot, robot.subscribe(PlanarPath) as paths:
            path = paths.newest()
    assert path is not None and path.frame == "odom" and 15 < len(path.xy) < 25
    assert path.xy[0] == pytest.approx((0.0, 0.0)) and path.xy[-1] == pytest.approx((1.0, 0.0), abs=0.06)


STORE = get_typestore(Stores.ROS2_HUMBLE)


def decoded(message: Outgoing, encode: Encoder) -> list[tuple[str, Any]]:
    """Return topics and messages of ROS 2."""
    return [(topic, STORE.deserialize_cdr(payload, PUBLISHED[topic].schema)) for topic, payload in encode(message)]


def test_a_cloud_has_a_bounded_number_of_points() -> None:
    xyz = np.arange(6 * CLOUD_POINTS, dtype=np.float32).reshape(-1, 3)
    ages = np.zeros(len(xyz), np.int32)
    points = MapPoints(xyz, np.linspace(0.1, 0.9, len(xyz), dtype=np.float32), ages, ages)
    [(topic, cloud)] = decoded(MapUpdate(1, 1, points, np.zeros((0, 2))), Encoder(RIG, 6.0, unix_ns))
    shown = np.frombuffer(cloud.data.tobytes(), np.float32).reshape(cloud.width, -1)[:, :3]
    assert topic == "cloud" and len(shown) <= CLOUD_POINTS and np.array_equal(shown, xyz[::3])


def test_the_static_frames_lead_from_the_base_to_the_cameras() -> None:
    rig = replace(make_rig(size=256), T_base_rig=se3.exp([0.1, 0.0, 0.4, 0.0, 0.1, 0.5]))
    topic, message = decoded(odometry(0), Encoder(rig, 6.0, unix_ns))[0]
    found = {}
    for edge in message.transforms:
        t, q = edge.transform.translation, edge.transform.rotation
        T = se3.transform(se3.rotation([q.x, q.y, q.z, q.w]), [t.x, t.y, t.z])
        found[edge.header.frame_id, edge.child_frame_id] = T
    assert topic == "/tf_static"
    assert list(found) == [("base_link", "rig"), ("rig", "lower"), ("rig", "upper")]
    np.testing.assert_allclose(found["base_link", "rig"], rig.T_base_rig, atol=1e-12)
    np.testing.assert_allclose(found["rig", "upper"] @ rig.upper.T_cam_rig, np.eye(4), atol=1e-9)


AHEAD = Setpoint(0.3, 0.0)


class Link:
    """A link without a process, which keeps the setpoints that it sends."""

    def __init__(self) -> None:
        self.setpoints: list[TimedSetpoint] = []
        self.send = self.setpoints.append


def test_setpoints_and_answers_of_the_navigation_are_sent() -> None:
    link, health = cast("Any", Link()), cast("Any", None)
    update = NavigationUpdate(1, 1, AHEAD, NavigationState.PAUSED, "by a request", answer=RequestAnswer(4, "pause", ""))
    refused = replace(update, setpoint=None, answer=RequestAnswer(5, "repeat lost", "no route lost"))
    assert navigation_answers(update) == {4: Answer(True, "accepted; navigation: paused: by a request")}
    reached = replace(update, state=NavigationState.REACHED, reason="")
    assert navigation_answers(reached) == {4: Answer(True, "accepted; no drive is under way")}
    assert navigation_answers(refused) == {5: Answer(False, "no route lost")}
    for each in (update, refused):
        LiveDrive(link, np.eye(4), health).process(each)
    (sent,) = link.setpoints
    assert (sent.setpoint, sent.source) == (AHEAD, PLANNER)
