"""What goes along with a pose beside its message of ROS 2, which has no place for it: JSON as zenoh's attachment."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Final

from omnid.errors import OmnidError

_LONGEST: Final = 4096  # bytes


@dataclass(frozen=True, slots=True)
class Note:
    """How sure a pose is, and what tells whether one was missed."""

    seq: int = -1
    state: str = "unknown"  # tracking | degraded | lost
    resets: int = 0  # how often odom had to start anew with an unknown gap
    inliers: int = 0  # landmarks that agree with the pose
    tracks: int = 0  # landmarks that were found
    sent_ns: int = 0  # of Unix time, when it was handed to the network


_USUAL: Final = asdict(Note())


def note_bytes(note: Note) -> bytes:
    """The note as it travels."""
    return json.dumps({name: getattr(note, name) for name in _USUAL}, separators=(",", ":")).encode()


def note_from_bytes(data: bytes) -> Note:
    """The note in an attachment; what it does not say is unknown. OmnidError unless it is one; any bytes may come."""
    try:
        found = json.loads(data) if len(data) <= _LONGEST else None
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise OmnidError(f"{len(data)} bytes beside a pose are no note in JSON; is it omnid that sends there?")
    known = {name: found[name] for name, usual in _USUAL.items() if type(found.get(name)) is type(usual)}
    return Note(**known)
