"""The publishers of the bus: for each topic the plain key, and what ROS 2 needs to find and to read it."""

from __future__ import annotations

import time
from typing import Any, Final

import zenoh
from zenoh import ext

from omnid.transport import ros2
from omnid.transport.bus_config import BusConfig
from omnid.transport.topics import PUBLISHED, Topic, ros_name

_HEARTBEAT_S: Final = 0.5  # rmw_zenoh's


class RosGraph:
    """The entries in the graph of ROS 2: a node and its topics."""

    def __init__(self, session: zenoh.Session, config: BusConfig) -> None:
        self._session, self._config = session, config
        self._node = ros2.RmwNode(config.ros2_domain, str(session.zid()), ros2.node_name(config.robot))
        self._tokens: list[zenoh.LivelinessToken] = []
        self._topics = list(PUBLISHED)  # their places are the ids of the entities
        if config.ros2 == "rmw_zenoh":
            self._declare(self._node.token)

    def publisher(self, topic: str, settings: Topic) -> str:
        """Declare a publisher and return its token, "" where ROS 2 is off."""
        if self._config.ros2 == "off":
            return ""
        name, entity = ros_name(self._config.robot, topic), self._entity(topic)
        token = self._node.publisher(entity, name, settings.schema, transient_local=settings.transient_local)
        return self._declare(token)

    def subscription(self, topic: str, schema: str) -> None:
        """Declare a subscription, where ROS 2 is not off."""
        if self._config.ros2 != "off":
            self._declare(self._node.subscription(self._entity(topic), ros_name(self._config.robot, topic), schema))

    def _entity(self, topic: str) -> int:
        """Return the number of a topic, which is unique in the node."""
        if topic not in self._topics:
            self._topics.append(topic)
        return 1 + self._topics.index(topic)

    def _declare(self, token: str) -> str:
        self._tokens.append(self._session.liveliness().declare_token(token))
        return token


class TopicPublisher:
    """The zenoh publishers of one topic: the plain key, and the key of ROS 2 where that is another."""

    def __init__(self, session: zenoh.Session, config: BusConfig, name: str, graph: RosGraph) -> None:
        topic, ros = PUBLISHED[name], ros_name(config.robot, name)
        plain = f"{config.robot}/{name.removeprefix('/')}"
        token = graph.publisher(name, topic)
        self._plain = _declared_publisher(session, plain, topic)
        self._ros: zenoh.Publisher | ext.AdvancedPublisher | None = None
        if config.ros2 == "rmw_zenoh":
            declared = _declared_keeper if topic.transient_local else _declared_publisher
            self._ros = declared(session, ros2.data_key(config.ros2_domain, ros, topic.schema), topic)
        self._gid = ros2.gid_of(token)
        self._seq = 0

    @property
    def is_received(self) -> bool:
        """True if there is a subscriber."""
        found: list[Any] = [
            publisher.matching_status
            for publisher in (self._plain, self._ros)
            if isinstance(publisher, zenoh.Publisher)
        ]  # zenoh's stub takes the status for a bool
        return any(status.matching for status in found)

    def put(self, payload: bytes, attachment: bytes | None) -> None:
        """Send to all subscribers; microseconds where there are none."""
        self._plain.put(payload, attachment=attachment)
        if self._ros is not None:
            self._seq += 1
            self._ros.put(payload, attachment=ros2.attachment(self._seq, time.time_ns(), self._gid))


def _declared_publisher(session: zenoh.Session, key: str, topic: Topic) -> zenoh.Publisher:
    """Declare a publisher, not express: each express message fills one of the few batches of every router on the way.

    Poses were dropped there, and the latency is the same.
    """
    return session.declare_publisher(
        key,
        encoding=zenoh.Encoding.APPLICATION_CDR,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME if topic.realtime else zenoh.Priority.DATA,
        express=False,
        reliability=zenoh.Reliability.RELIABLE,
    )


def _declared_keeper(session: zenoh.Session, key: str, topic: Topic) -> ext.AdvancedPublisher:
    """Declare a publisher that keeps its newest message for late subscribers, as rmw_zenoh does for transient local.

    rmw_publisher_data.cpp of ros2/rmw_zenoh: a cache, detection of the publisher, sporadic heartbeats.
    """
    return ext.declare_advanced_publisher(
        session,
        key,
        encoding=zenoh.Encoding.APPLICATION_CDR,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA,
        express=False,
        reliability=zenoh.Reliability.RELIABLE,
        cache=ext.CacheConfig(1),
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
        publisher_detection=True,
    )
