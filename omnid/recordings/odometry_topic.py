"""The one rule for which topic of a recording holds the poses.

1. A topic or a robot that the user names is taken; it must hold nav_msgs/msg/Odometry.
2. Else the only topic with messages of that type is taken.
3. Of several, the only one that has omnid's name `.../odom` is taken.
4. Else the user must name one.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from drivers.logs.log import LogInfo
from drivers.logs.ros_messages import IMAGE_TYPES
from omnid.errors import OmnidError
from omnid.transport.codec import ODOMETRY_SCHEMA

_MAX_LISTED: Final = 8
_OWN_NAME: Final = "/odom"  # end of the name under which omnid records poses


def odometry_topics(found: LogInfo) -> list[str]:
    """Return the topics that hold odometry messages."""
    return [name for name, (schema, count) in found.topics.items() if schema == ODOMETRY_SCHEMA and count]


def choose_odometry_topic(found: LogInfo, topic: str | None = None, robot: str | None = None) -> str:
    """Return the topic of the poses by the rule above.

    topic: the full name, such as /omnid/odom; robot: stands for /<robot>/odom. Raise OmnidError where there is no
    such topic, or several and none is named.
    """
    known = odometry_topics(found)
    if topic is None and robot is not None:
        topic = f"/{robot.strip('/')}{_OWN_NAME}"
    if topic is not None:
        if topic not in known:
            raise OmnidError(
                f"{found.path}: no {ODOMETRY_SCHEMA} on {topic!r}: found {_listed(known)}; name one of these topics"
            )
        return topic
    if not known:
        raise OmnidError(_no_odometry(found))
    own = [name for name in known if name.endswith(_OWN_NAME)]
    if len(known) == 1 or len(own) == 1:
        return known[0] if len(known) == 1 else own[0]
    raise OmnidError(f"{found.path}: several topics with {ODOMETRY_SCHEMA}: {_listed(known)}; choose one with --topic")


def no_pose(path: Path, topic: str) -> OmnidError:
    """Return the error for a log whose topic of the poses has none that can be read."""
    return OmnidError(
        f"{path}: topic {topic!r} has no readable pose; `omnid log info {path}` tells whether the log is complete"
    )


def _no_odometry(found: LogInfo) -> str:
    if any(schema in IMAGE_TYPES for schema, _ in found.topics.values()):
        rig = "" if "rig.toml" in found.attachments else " --rig rig.toml"
        return (
            f"{found.path}: images but no {ODOMETRY_SCHEMA}: run `omnid replay {found.path}{rig} --record "
            "out.mcap` and use out.mcap"
        )
    return f"{found.path}: no {ODOMETRY_SCHEMA}: found {_listed(found.topics)}; expected a recording of a run"


def _listed(names: Iterable[str]) -> str:
    every = sorted(names)
    shown = ", ".join(ascii(name) for name in every[:_MAX_LISTED]) or "none"
    return shown + (f" and {len(every) - _MAX_LISTED} more" if len(every) > _MAX_LISTED else "")
