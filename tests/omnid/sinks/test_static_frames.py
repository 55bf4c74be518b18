"""The static frames of the rig and its cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from calib import se3
from omnid.messages import OdometryUpdate
from omnid.sinks.encoder import Encoder, MapEncoding
from omnid.sinks.recorder import Recorder, SingleLog
from omnid.sinks.static_frames import StaticFrames
from tests.omnid.small_pair import small_depth
from tests.simulation import make_rig

STORE = get_typestore(Stores.ROS2_HUMBLE)
RIG = replace(make_rig(size=256), T_base_rig=se3.exp([0.1, 0.0, 0.4, 0.0, 0.1, 0.5]))


def edges(payload: bytes) -> dict[tuple[str, str], np.ndarray]:
    found = {}
    for edge in cast("Any", STORE.deserialize_cdr(payload, "tf2_msgs/msg/TFMessage")).transforms:
        t, q = edge.transform.translation, edge.transform.rotation
        T = se3.transform(se3.rotation([q.x, q.y, q.z, q.w]), [t.x, t.y, t.z])
        found[edge.header.frame_id, edge.child_frame_id] = T
    return found


def test_the_frames_lead_from_the_base_to_the_cameras() -> None:
    (message,) = StaticFrames(Encoder(RIG.T_base_rig, MapEncoding(1), 10**18, RIG))(5)
    found = edges(message.payload)
    assert message.topic == "/tf_static"
    assert list(found) == [("base_link", "rig"), ("rig", "lower"), ("rig", "upper")]
    np.testing.assert_allclose(found["base_link", "rig"], RIG.T_base_rig, atol=1e-12)
    np.testing.assert_allclose(found["rig", "upper"] @ RIG.upper.T_cam_rig, np.eye(4), atol=1e-9)


def test_they_are_given_once() -> None:
    frames = StaticFrames(Encoder(RIG.T_base_rig, MapEncoding(1), 0, RIG))
    assert [len(list(frames(stamp_ns))) for stamp_ns in (1, 2, 3)] == [1, 0, 0]


def test_a_recording_keeps_them_for_late_subscribers_of_its_player(tmp_path: Path) -> None:
    """rosbag2 publishes them as transient local, as the quality that is stored with the topic says."""
    recorder = Recorder(SingleLog(tmp_path / "a.mcap", {}), "omnid", Encoder(RIG.T_base_rig, MapEncoding(1), 0, RIG))
    for seq in range(3):
        recorder.process(
            OdometryUpdate(
                seq, 10**18 + seq, np.eye(4), np.eye(6), np.zeros(6), np.eye(6), "tracking", 0, 9, 9, small_depth()
            )
        )
    recorder.finish()
    with AnyReader([tmp_path / "a.mcap"]) as bag:
        (connection,) = [found for found in bag.connections if found.topic == "/tf_static"]
        (stored,) = cast("Any", connection.ext).offered_qos_profiles
        messages = [data for _, _, data in bag.messages([connection])]
    assert (stored.history.name, stored.depth, stored.reliability.name, stored.durability.name) == (
        "KEEP_LAST",
        1,
        "RELIABLE",
        "TRANSIENT_LOCAL",
    )
    assert len(messages) == 1
