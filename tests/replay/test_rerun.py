"""The recording of a live run is a log: its replay gives the same trajectory."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from calib.rig_file import parse_rig, rig_toml
from drivers.logs.log_reader import LogReader
from omnid.transport.status_names import ODOMETRY, WHEELS, camera_name, stage_name
from tests.replay.command import Command
from tests.replay.recorded import recorded_run

POSES = 18
ODOM = "/omnid/odom"
IMAGES = ("/omnid/lower/image_raw/compressed", "/omnid/upper/image_raw/compressed")
PUBLISHED = {
    "/omnid/odom",
    "/omnid/pose",
    "/omnid/map_pose",
    "/tf",
    "/omnid/cloud",
    "/omnid/map",
    "/omnid/status",
    "/omnid/drive",
    *IMAGES,
}


class Message(NamedTuple):
    """One message of a recording."""

    topic: str
    log_ns: int
    content: Any  # as rosbags gives it

    @property
    def stamp_ns(self) -> int:
        """That of its header."""
        first = self.content.transforms[0] if self.topic == "/tf" else self.content
        return int(first.header.stamp.sec) * 10**9 + int(first.header.stamp.nanosec)


@pytest.fixture(scope="module")
def recording(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of `omnid run`."""
    return recorded_run(scene, tmp_path_factory.mktemp("recording"), POSES)


@pytest.fixture(scope="module")
def messages(recording: Path) -> list[Message]:
    """Return all messages, as another program reads them."""
    with AnyReader([recording]) as bag:
        return [
            Message(place.topic, at_ns, bag.deserialize(data, place.msgtype)) for place, at_ns, data in bag.messages()
        ]


def of(messages: list[Message], topic: str) -> list[Message]:
    return [message for message in messages if message.topic == topic]


def transforms(messages: list[Message], child: str) -> list[Message]:
    """The messages of /tf with an edge to a frame: places publish theirs beside those of odometry."""
    return [
        message
        for message in of(messages, "/tf")
        if any(edge.child_frame_id == child for edge in message.content.transforms)
    ]


def test_a_recording_holds_all_messages_rig_and_settings(recording: Path, messages: list[Message], scene: Path) -> None:
    assert {message.topic for message in messages} >= set(PUBLISHED)
    reader = LogReader(recording)
    attached = reader.attachments()
    reader.close()
    settings = tomllib.loads(attached["omnid.toml"].decode())
    assert settings["record"]["enabled"] and settings["motor"]["port"].endswith("motor")
    ours, theirs = parse_rig(attached["rig.toml"]), parse_rig((scene / "rig.toml").read_bytes(), scene)
    assert rig_toml(ours).splitlines()[:30] == rig_toml(theirs).splitlines()[:30]
    assert any(message.content.twist.linear.x > 0.1 for message in of(messages, "/omnid/drive")), "it drove"
    assert any(message.content.width > 100 for message in of(messages, "/omnid/cloud")), "there is a map"
    parts = {status.name for message in of(messages, "/omnid/status") for status in message.content.status}
    assert parts >= {ODOMETRY, WHEELS, camera_name("lower"), stage_name("odometry")}


def test_log_times_are_the_stamps(messages: list[Message]) -> None:
    """A message is logged at its stamp; a pose has that of an image of the lower camera."""
    assert all(message.log_ns == message.stamp_ns for message in messages if message.topic in PUBLISHED)
    lower = {message.stamp_ns for message in of(messages, IMAGES[0])}
    poses = [message.stamp_ns for message in of(messages, "/omnid/odom")]
    assert set(poses) <= lower and len(poses) > POSES // 2
    assert [message.stamp_ns for message in of(messages, "/omnid/pose")] == poses
    assert [message.stamp_ns for message in transforms(messages, "base_link")] == poses
    in_map = [message.stamp_ns for message in of(messages, "/omnid/map_pose")]
    assert [message.stamp_ns for message in transforms(messages, "odom")] == in_map and set(in_map) <= set(poses)


def test_all_messages_of_a_pose_agree(messages: list[Message]) -> None:
    """Odometry, PoseStamped and the transform hold the same pose."""
    pose_messages = zip(
        of(messages, "/omnid/odom"), of(messages, "/omnid/pose"), transforms(messages, "base_link"), strict=True
    )
    for odom, pose, tf in (tuple(message.content for message in three) for three in pose_messages):
        assert odom.pose.pose == pose.pose
        edge = next(edge for edge in tf.transforms if edge.child_frame_id == "base_link")
        position, moved = odom.pose.pose.position, edge.transform.translation
        assert (position.x, position.y, position.z) == (moved.x, moved.y, moved.z)
        assert odom.pose.pose.orientation == edge.transform.rotation


def poses_of(log: Path) -> dict[int, np.ndarray]:
    """Return the positions by the stamps of their poses."""
    with AnyReader([log]) as bag:
        odometry = [bag.deserialize(data, place.msgtype) for place, _, data in bag.messages() if place.topic == ODOM]
    stamps = [int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec) for message in odometry]
    places = [message.pose.pose.position for message in odometry]
    return {stamp: np.array([place.x, place.y, place.z]) for stamp, place in zip(stamps, places, strict=True)}


def test_a_replay_gives_the_same_trajectory(omnid: Command, tmp_path: Path, recording: Path) -> None:
    """The replay uses only the images, rig and attachments of the recording."""
    again, paper = tmp_path / "again.mcap", tmp_path / "paper.mcap"
    assert omnid.replay(recording, "--record", again).code == 0
    ours, theirs = poses_of(recording), poses_of(again)
    common = ours.keys() & theirs.keys()
    assert len(common) > POSES // 4
    # Where a busy computer dropped pairs of the live run, the replay sees other pairs than it.
    limit_m = 0.0 if ours.keys() == theirs.keys() else 0.02
    assert max(float(np.linalg.norm(ours[stamp] - theirs[stamp])) for stamp in common) <= limit_m

    assert omnid.replay(recording, "--record", paper, "--method", "paper").code == 0
    others = poses_of(paper)
    assert max(float(np.linalg.norm(others[stamp] - theirs[stamp])) for stamp in others.keys() & theirs) > 1e-4
