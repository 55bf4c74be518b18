"""Rerun checks and reads recordings (tested with rerun-sdk 0.41.0): poses, transforms, points and images as its own
three-dimensional entities, in float32; all other messages field by field.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.interop.conftest import Known
from tests.interop.known import Expected
from tests.interop.programs import HERE, lines, program, run

pytestmark = pytest.mark.interop

FIELDS = {
    "/omnid/odom": "nav_msgs.msg.Odometry",
    "/omnid/status": "diagnostic_msgs.msg.DiagnosticArray",
    "/omnid/drive": "geometry_msgs.msg.TwistStamped",
}
FLOAT32 = 1e-6  # of numbers around 1

Parts = dict[str, list[dict[str, Any]]]  # topic -> components of each message, in order


@pytest.fixture
def parts(known: Known) -> Parts:
    """The known log as read by Rerun."""
    return read(known.path)


def read(log: Path) -> Parts:
    """Return all messages of a log; Rerun may split one into several rows."""
    python = program("rerun", "rerun-sdk").resolve().with_name("python")
    found: dict[str, dict[int, dict[str, Any]]] = {}
    for entry in lines([python, HERE / "read_log_rerun.py", log], log.parent):
        found.setdefault(entry["topic"], {}).setdefault(entry["log_ns"], {}).update(entry["parts"])
    return {topic: [messages[at_ns] for at_ns in sorted(messages)] for topic, messages in found.items()}


def test_reads_every_message(known: Known, parts: Parts) -> None:
    assert {topic: len(messages) for topic, messages in parts.items()} == {
        topic: len(messages) for topic, messages in known.expected.items()
    }


@pytest.mark.parametrize("topic", FIELDS)
def test_reads_the_fields_that_were_written(known: Known, parts: Parts, topic: str) -> None:
    assert [message[f"{FIELDS[topic]}:message"] for message in parts[topic]] == [
        [message] for message in known.expected[topic]
    ]


def test_reads_the_poses_and_transforms_that_were_written(known: Known, parts: Parts) -> None:
    written: Expected = known.expected
    for found, pose in zip(parts["/omnid/pose"], written["/omnid/pose"], strict=True):
        assert found["CoordinateFrame:frame"] == ["odom"]
        close(found["InstancePoses3D:translations"][0], pose["pose"]["position"])
        close(found["InstancePoses3D:quaternions"][0], pose["pose"]["orientation"])
    for found, message in zip(parts["/tf"], written["/tf"], strict=True):
        (edge,) = message["transforms"]
        assert found["Transform3D:parent_frame"] == ["odom"] and found["Transform3D:child_frame"] == ["base_link"]
        close(found["Transform3D:translation"][0], edge["transform"]["translation"])
        close(found["Transform3D:quaternion"][0], edge["transform"]["rotation"])


def test_reads_the_points_and_images_that_were_written(known: Known, parts: Parts) -> None:
    for found, cloud in zip(parts["/omnid/cloud"], known.expected["/omnid/cloud"], strict=True):
        points = np.column_stack([found["Points3D:positions"], found["Points3D:confidence"]])
        assert points.tolist() == cloud["points"]
        assert found["sensor_msgs.msg.PointCloud2:data"] == [cloud["data"]]
    lower, upper = "/omnid/lower/image_raw/compressed", "/omnid/upper/image_raw"
    for found, image in zip(parts[lower], known.expected[lower], strict=True):
        assert found["EncodedImage:blob"] == [image["data"]]
    for found, image in zip(parts[upper], known.expected[upper], strict=True):
        (shape,) = found["DepthImage:format"]  # as for all raw images with one channel
        assert found["DepthImage:buffer"] == [image["data"]] and (shape["width"], shape["height"]) == (32, 24)


def test_check_finds_no_problem(known: Known, live: Path, tmp_path: Path) -> None:
    """`rerun mcap check` always exits 0. With --full it reports its own splitting of clouds as a fault."""
    for log in (known.path, live):
        output = run([program("rerun", "rerun-sdk"), "mcap", "check", log], tmp_path)
        assert "PROBLEM" not in output and output.count("\nok ") >= 8, output


def test_reads_a_complete_live_recording(live: Path) -> None:
    counts = {topic: len(messages) for topic, messages in read(live).items()}
    assert len(counts) >= 8 and counts["/omnid/odom"] == counts["/omnid/pose"] == counts["/tf"] > 5


def close(found: list[float], written: dict[str, float]) -> None:
    np.testing.assert_allclose(found, list(written.values()), atol=FLOAT32)
