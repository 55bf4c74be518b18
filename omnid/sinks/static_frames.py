"""The frames that do not move on the robot, as /tf_static: base_link -> rig -> lower and upper, the cameras."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from calib import se3
from omnid.sinks.encoder import Encoder, OutgoingMessage
from omnid.transport.codec import TRANSFORM_SCHEMA, transform_cdr
from omnid.transport.records import FrameTransform

TF_STATIC: Final = "/tf_static"


class StaticFrames:
    """Yields the frames at the first call."""

    def __init__(self, encode: Encoder) -> None:
        self._encode, self._is_given = encode, False

    def __call__(self, stamp_ns: int) -> Iterator[OutgoingMessage]:
        """Yield the message the first time; stamp_ns: of a pose."""
        if self._is_given:
            return
        edges = [FrameTransform("base_link", "rig", self._encode.T_base_rig)]
        rig = self._encode.rig
        if rig is not None:
            edges += [
                FrameTransform("rig", name, se3.inverse(camera.T_cam_rig))
                for name, camera in (("lower", rig.lower), ("upper", rig.upper))
            ]
        payload = transform_cdr(stamp_ns + self._encode.offset_ns, edges)
        self._is_given = True
        yield OutgoingMessage(TF_STATIC, TRANSFORM_SCHEMA, payload)
