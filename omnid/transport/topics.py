"""What is said on the bus: names, types, and how urgent each is. A name with a leading '/' is the same for all robots.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from omnid.transport import codec

IMAGE_SCHEMA: Final = "sensor_msgs/msg/CompressedImage"
EMPTY_SCHEMA: Final = "std_msgs/msg/Empty"


class Topic(NamedTuple):
    """A topic and how it travels."""

    schema: str  # the type of ROS 2
    realtime: bool = False  # it overtakes all others
    late: bool = False  # whoever comes late gets the newest at once


SAID: Final = {
    "odom": Topic(codec.ODOMETRY_SCHEMA, realtime=True, late=True),
    "pose": Topic(codec.POSE_SCHEMA, realtime=True, late=True),
    "/tf": Topic(codec.TRANSFORM_SCHEMA, realtime=True),
    "status": Topic(codec.DIAGNOSTICS_SCHEMA, late=True),
    "cloud": Topic(codec.POINT_CLOUD_SCHEMA, late=True),
    "map": Topic(codec.GRID_SCHEMA, late=True),
    "drive": Topic(codec.TWIST_SCHEMA),
    "panorama": Topic(IMAGE_SCHEMA),
}
HEARD: Final = {
    "cmd/twist": codec.TWIST_SCHEMA,
    "cmd/heading": codec.VECTOR_SCHEMA,
    "cmd/stop": EMPTY_SCHEMA,
}
