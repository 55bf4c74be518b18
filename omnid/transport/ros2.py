"""Keys, attachments and liveliness tokens by which ROS 2 discovers and reads the topics; needs no ROS here.

rmw_zenoh (attachment_helpers.cpp, liveliness_utils.cpp of ros2/rmw_zenoh): a data key with the type and its hash, an
attachment to every sample, liveliness tokens for the node and each of its publishers and subscriptions.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from functools import cache
from typing import Final

from rosbags.typesys import Stores, get_typestore

RELIABLE_LAST_10: Final = "::,10:,:,:,,"  # what is empty is rmw_zenoh's default: reliable, volatile, keep last
TRANSIENT_LOCAL: Final = ":1:,1:,:,:,,"  # the newest message is kept for later subscribers, as of /tf_static
GID_BYTES: Final = 16
_PLAIN_BYTES: Final = struct.calcsize("<qqB") + GID_BYTES  # of an attachment of rmw_zenoh
_ECHO_BYTES: Final = _PLAIN_BYTES + struct.calcsize("<q")  # of one of omnid's clients


@cache
def type_hash(schema: str) -> str:
    """Return the hash of a message type such as nav_msgs/msg/Odometry (REP 2016), the same since Humble."""
    return str(get_typestore(Stores.ROS2_HUMBLE).hash_rihs01(schema))


def dds_type(schema: str) -> str:
    """Return the DDS name of a type such as nav_msgs/msg/Odometry."""
    package, kind, name = schema.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def data_key(domain: int, topic: str, schema: str) -> str:
    """Return the zenoh key of a topic with rmw_zenoh; topic with its leading '/'."""
    return f"{domain}{topic}/{dds_type(schema)}/{type_hash(schema)}"


def attachment(seq: int, source_ns: int, gid: bytes, echo_ns: int = 0) -> bytes:
    """Return the attachment that rmw_zenoh expects: sequence number, time of sending [ns], the publisher's id.

    echo_ns: to a robot its own time, which follows the id; 0: it is left out.
    """
    return struct.pack("<qqB", seq, source_ns, GID_BYTES) + gid + (struct.pack("<q", echo_ns) if echo_ns else b"")


def gid_in(attached: bytes) -> str:
    """Return the publisher's id in an attachment of rmw_zenoh, in hexadecimal; empty for any other attachment."""
    is_one = len(attached) in (_PLAIN_BYTES, _ECHO_BYTES) and attached[_PLAIN_BYTES - GID_BYTES - 1] == GID_BYTES
    return attached[_PLAIN_BYTES - GID_BYTES : _PLAIN_BYTES].hex() if is_one else ""


def sent_ns_in(attached: bytes) -> int:
    """Return the time of sending in an attachment of rmw_zenoh [ns of Unix time]; 0 for any other attachment."""
    return int(struct.unpack_from("<q", attached, 8)[0]) if gid_in(attached) else 0


def echo_ns_in(attached: bytes) -> int:
    """Return the robot's own time in an attachment of omnid's clients; 0 for any other attachment."""
    is_one = len(attached) == _ECHO_BYTES and gid_in(attached)
    return int(struct.unpack_from("<q", attached, _PLAIN_BYTES)[0]) if is_one else 0


def gid_of(token: str) -> bytes:
    """Return the unique id (16 bytes) of the publisher with this token."""
    return hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()


@dataclass(frozen=True, slots=True)
class RmwNode:
    """A node of ROS 2 in rmw_zenoh's liveliness tokens."""

    domain: int
    zid: str  # of the session
    name: str

    @property
    def token(self) -> str:
        """Token of the node itself."""
        return f"@ros2_lv/{self.domain}/{self.zid}/0/0/NN/%/%/{self.name}"

    def publisher(self, entity: int, topic: str, schema: str, *, transient_local: bool = False) -> str:
        """Return the token of a publisher; entity: a number unique in the node."""
        return self._endpoint("MP", entity, topic, schema, TRANSIENT_LOCAL if transient_local else RELIABLE_LAST_10)

    def subscription(self, entity: int, topic: str, schema: str) -> str:
        """Return the token of a subscription; entity: a number unique in the node."""
        return self._endpoint("MS", entity, topic, schema, RELIABLE_LAST_10)

    def _endpoint(self, kind: str, entity: int, topic: str, schema: str, quality: str) -> str:
        where = f"@ros2_lv/{self.domain}/{self.zid}/0/{entity}/{kind}/%/%/{self.name}"
        return f"{where}/{topic.replace('/', '%')}/{dds_type(schema)}/{type_hash(schema)}/{quality}"


def node_name(robot: str) -> str:
    """Return the name of the node: the last part of the robot's name."""
    return robot.rsplit("/", 1)[-1]
