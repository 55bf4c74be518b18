"""The cameras of a live run, and their first images, in which the rig's missing masks are found."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import ExitStack, closing
from itertools import islice
from typing import Final, Protocol, TypeAlias

from drivers.cameras.camera_state import CameraState
from drivers.frame import CAMERAS, Camera, Frame, FrameSource
from omnid.engine.flow import nothing

MASK_FRAMES: Final = 60  # images of each camera in which the rim is searched, where the rig has no mask


class LiveCamera(FrameSource, Protocol):
    """A source of frames with a state for the status."""

    state: CameraState


OpenCamera: TypeAlias = Callable[[Camera], LiveCamera]  # called a second time after the first camera was closed


def first_frames(open_camera: OpenCamera) -> Generator[Frame, None, None]:
    """Yield the first frames of both cameras in turn; the cameras are open until this generator is closed."""
    with ExitStack() as cameras:
        streams = []
        for name in CAMERAS:
            camera = cameras.enter_context(closing(open_camera(name)))
            frames = iter(camera.frames())
            cameras.callback(getattr(frames, "close", nothing))  # a generator holds the device until it is closed
            streams.append(islice(frames, MASK_FRAMES))
        for pair in zip(*streams, strict=False):
            yield from pair
