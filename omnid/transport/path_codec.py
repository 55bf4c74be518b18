"""The driven path as nav_msgs/msg/Path: little-endian CDR (OMG RTPS 2.2, 10.2), all poses at once."""

from __future__ import annotations

from struct import pack
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.stores import ros2_humble as ros

from omnid.transport import codec
from omnid.transport.navigation_codec import PATH_SCHEMA

FRAME: Final = "odom"
# A PoseStamped of this frame: 17 bytes of header, padded to the 8 bytes of doubles, and 7 doubles.
_POSE: Final = np.dtype(
    {
        "names": ["sec", "nanosec", "length", "frame", "pose"],
        "formats": ["<i4", "<u4", "<u4", "S5", ("<f8", 7)],
        "offsets": [0, 4, 8, 12, 24],
        "itemsize": 80,
    }
)


def driven_path_cdr(stamp_ns: int, stamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> bytes:
    """Encode poses (N, 7), x y z [m] and quaternion x y z w, with their stamps (N,), in odom.

    Raise OmnidError where stamp_ns does not fit a ROS time.
    """
    head = codec.message_cdr(ros.nav_msgs__msg__Path(codec.header_message(stamp_ns, FRAME), []), PATH_SCHEMA)
    entries = np.zeros(len(poses), _POSE)
    entries["sec"], entries["nanosec"] = np.divmod(stamps_ns, codec.NS_PER_S)
    entries["length"], entries["frame"], entries["pose"] = len(FRAME) + 1, FRAME.encode(), poses
    return b"".join((head[:-4], pack("<I", len(poses)), entries.tobytes()))
