"""The frames that do not move on the robot, as /tf_static: base_link -> rig -> lower and upper, the cameras."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from calib import se3
from omnid.sinks.encoder import Encoder, OutgoingMessage
from omnid.transport.codec import TRANSFORM_SCHEMA, FrameTransform, transform_cdr

TF_STATIC: Final = "/tf_static"


class StaticFrames:
    """Yields the frames at the first call, and again when a run goes on with a refined rig."""

    def __init__(self, encode: Encoder) -> None:
        self._encode, self._version = encode, -1

    def __call__(self, stamp_ns: int) -> Iterator[OutgoingMessage]:
        """Yield the message if its content differs from the last one; stamp_ns: of a pose."""
        versions = self._encode.versions
        newest = 0 if versions is None else versions.newest
        if newest == self._version:
            return
        edges = [FrameTransform("base_link", "rig", self._encode.T_base_rig)]
        if versions is not None:
            rig = versions[newest].rig
            edges += [FrameTransform("rig", name, se3.inverse(camera.T_cam_rig))
                      for name, camera in (("lower", rig.lower), ("upper", rig.upper))]
        payload = transform_cdr(stamp_ns + self._encode.offset_ns, edges)
        self._version = newest
        yield OutgoingMessage(TF_STATIC, TRANSFORM_SCHEMA, payload)
