"""The zenoh attachment of a pose: JSON with what its ROS 2 message has no field for."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Final, Self

from omnid.errors import OmnidError

_MAX_BYTES: Final = 4096


@dataclass(frozen=True, slots=True)
class PoseAttachment:
    """Sequence number, tracking state and landmark counts of a pose."""

    seq: int = -1
    state: str = "unknown"  # tracking | degraded | lost
    resets: int = 0  # how often odom was started again with an unknown gap
    inliers: int = 0  # landmarks that agree with the pose
    tracked: int = 0  # landmarks found in the images
    sent_ns: int = 0  # Unix time at which it was handed to the network

    def to_bytes(self) -> bytes:
        """Encode as JSON."""
        return json.dumps(asdict(self), separators=(",", ":")).encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Decode; missing entries keep their defaults. Raise OmnidError for anything but a JSON object."""
        try:
            found = json.loads(data) if len(data) <= _MAX_BYTES else None
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise OmnidError(
                f"the {len(data)} bytes attached to a pose are not a JSON object; check that omnid sent them"
            )
        defaults = asdict(cls())
        known = {name: found[name] for name, default in defaults.items() if type(found.get(name)) is type(default)}
        return cls(**known)
