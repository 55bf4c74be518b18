"""Keys, attachments and liveliness tokens by which ROS 2 discovers and reads the topics; needs no ROS here.

rmw_zenoh (attachment_helpers.cpp, liveliness_utils.cpp of ros2/rmw_zenoh): a data key with the type and its hash, an
attachment to every sample, liveliness tokens for the node and each of its publishers and subscriptions.
"""

from __future__ import annotations

import hashlib
from functools import cache
from itertools import count
from struct import Struct
from typing import Final, NamedTuple

import zenoh
from rosbags.typesys import Stores, get_typestore

from omnid.transport.topics import ros_name

RELIABLE_LAST_10: Final = "::,10:,:,:,,"  # what is empty is rmw_zenoh's default: reliable, volatile, keep last
TRANSIENT_LOCAL: Final = ":1:,1:,:,:,,"  # the newest message is kept for later subscribers, as of /tf_static
GID_BYTES: Final = 16
_HEAD: Final = Struct(f"<qqB{GID_BYTES}s")  # of an attachment
_ECHO: Final = Struct("<q")


@cache
def type_hash(schema: str) -> str:
    """Return the hash of a message type such as nav_msgs/msg/Odometry (REP 2016), the same since Humble."""
    return str(get_typestore(Stores.ROS2_HUMBLE).hash_rihs01(schema))


def _type_key(schema: str) -> str:
    """Return the part of a key with the DDS name of a type such as nav_msgs/msg/Odometry, and its hash."""
    package, kind, name = schema.split("/")
    return f"{package}::{kind}::dds_::{name}_/{type_hash(schema)}"


def data_key(domain: int, topic: str, schema: str) -> str:
    """Return the zenoh key of a topic with rmw_zenoh; topic with its leading '/'."""
    return f"{domain}{topic}/{_type_key(schema)}"


class Attachment(NamedTuple):
    """What is attached to a message by rmw_zenoh, or by a client of omnid."""

    gid: str = ""  # id of the publisher, in hexadecimal
    sent_ns: int = 0  # time of sending, of Unix time
    echo_ns: int = 0  # the robot's own time, by a client of omnid; 0: there is none


def attachment(seq: int, source_ns: int, gid: bytes, echo_ns: int = 0) -> bytes:
    """Return the attachment that rmw_zenoh expects: sequence number, time of sending [ns], the publisher's id.

    echo_ns: to a robot its own time, which follows the id; 0: it is left out.
    """
    return _HEAD.pack(seq, source_ns, GID_BYTES, gid) + (_ECHO.pack(echo_ns) if echo_ns else b"")


def read_attachment(attached: bytes) -> Attachment:
    """Return the content of an attachment; that of any other bytes is empty."""
    if len(attached) not in (_HEAD.size, _HEAD.size + _ECHO.size):
        return Attachment()
    _, sent_ns, gid_bytes, gid = _HEAD.unpack_from(attached)
    echo_ns = int.from_bytes(attached[_HEAD.size :], "little", signed=True)
    return Attachment(gid.hex(), sent_ns, echo_ns) if gid_bytes == GID_BYTES else Attachment()


def gid_of(token: str) -> bytes:
    """Return the unique id (16 bytes) of the publisher with this token."""
    return hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()


class RosNode:
    """A session as a node of ROS 2: the tokens of the node, of its publishers and of its subscriptions."""

    def __init__(self, session: zenoh.Session, robot: str, domain: int, *, is_on: bool) -> None:
        """robot: its name, of which the last part is that of the node. is_on: False: tokens are not declared."""
        self._session, self._robot, self._is_on = session, robot, is_on
        self._prefix, self._name = f"@ros2_lv/{domain}/{session.zid()}/0", robot.rsplit("/", 1)[-1]
        self._entities = count(1)
        self._tokens: list[zenoh.LivelinessToken] = []
        self._declare(f"{self._prefix}/0/NN/%/%/{self._name}")

    def publisher(self, topic: str, schema: str, *, latched: bool) -> str:
        """Declare a publisher of a robot's topic and return its token."""
        return self._endpoint("MP", topic, schema, TRANSIENT_LOCAL if latched else RELIABLE_LAST_10)

    def subscription(self, topic: str, schema: str) -> None:
        """Declare a subscription of a robot's topic."""
        self._endpoint("MS", topic, schema, RELIABLE_LAST_10)

    def _endpoint(self, kind: str, topic: str, schema: str, quality: str) -> str:
        name = ros_name(self._robot, topic).replace("/", "%")
        where = f"{self._prefix}/{next(self._entities)}/{kind}/%/%/{self._name}"
        return self._declare(f"{where}/{name}/{_type_key(schema)}/{quality}")

    def _declare(self, token: str) -> str:
        if self._is_on:
            self._tokens.append(self._session.liveliness().declare_token(token))
        return token
