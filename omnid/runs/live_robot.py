"""The robot of a live run: its clock, its cameras with their first images, its samples and its wheels."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, closing
from functools import partial
from itertools import islice
from typing import Final, Protocol, TypeAlias

from drivers.cameras.camera_state import CameraState
from drivers.frame import CAMERAS, Camera, Frame, FrameSource
from drivers.motion import MotionSample
from omnid.controller.link import DriveLink
from omnid.engine.flow import nothing
from omnid.engine.graph import Graph, Stream
from omnid.runs.sensor_sources import MotionSource
from omnid.runs.session import Session
from omnid.transport.records import DiagnosticStatus

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


class LiveRobot(Protocol):
    """A robot, or a simulated one, as a live run sees it."""

    @property
    def waits(self) -> bool:
        """True if its time is stopped until the run has answered: nothing is dropped or omitted under load."""

    @property
    def brings_samples(self) -> bool:
        """True if wheels and gyro come with the images: no others fit them."""

    def clock_ns(self) -> int:
        """Return the time, by the clock of the stamps of images, poses and ticks [ns]."""

    def first_frames(self) -> Generator[Frame, None, None]:
        """Yield the first frames of both cameras in turn, for the rims of the mirrors."""

    def connect(self, session: Session) -> DriveLink | None:
        """Open the cameras and start the controller; None without wheels. Outputs of the session close them."""

    def sources(self, graph: Graph, take: Callable[[MotionSample], None]) -> list[Stream[Frame]]:
        """Add the sources of the images to a graph. take: takes the samples that come with them, from any thread."""

    def states(self) -> Mapping[Camera, CameraState]:
        """Return the states of the cameras."""

    def words(self) -> str:
        """Return what the line on a terminal ends with."""

    @property
    def status(self) -> tuple[Callable[[], DiagnosticStatus], ...]:
        """Functions that make the entries of the status that only this kind of robot has."""


class ConnectedRobot:
    """Cameras, or the images of a log in their place, and a motor controller on a serial port, in real time."""

    waits: Final = False

    def __init__(
        self, open_camera: OpenCamera, motion: MotionSource | None = None, gyro: MotionSource | None = None
    ) -> None:
        """motion: wheels and gyro where the images are those of a log; None: those of the robot.

        gyro: that of a simulated robot; None: samples of a gyro come by the bus.
        """
        self._open_camera, self._motion, self._gyro = open_camera, motion, gyro
        self.brings_samples = motion is not None
        self._cameras: dict[Camera, LiveCamera] = {}

    def clock_ns(self) -> int:
        """Return CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def first_frames(self) -> Generator[Frame, None, None]:
        """Open the cameras for their first frames."""
        return first_frames(self._open_camera)

    def connect(self, session: Session) -> DriveLink | None:
        """Open the cameras, and start the controller process where there is a motor."""
        outputs: ExitStack = session.outputs
        self._cameras = {name: outputs.enter_context(closing(self._open_camera(name))) for name in CAMERAS}
        return session.start_controller(session.config.realtime) if session.config.motor.port else None

    def sources(self, graph: Graph, take: Callable[[MotionSample], None]) -> list[Stream[Frame]]:
        """Add the cameras, and the samples of a log."""
        for name, motion in (("motion", self._motion), ("gyro", self._gyro)):
            if motion is not None:
                graph.source(name, partial(map, take, motion.samples()), wake=motion.close)
        return [graph.source(name, camera.frames, wake=camera.close) for name, camera in self._cameras.items()]

    def states(self) -> Mapping[Camera, CameraState]:
        """Return the states of the cameras."""
        return {name: camera.state for name, camera in self._cameras.items()}

    def words(self) -> str:
        """Return nothing."""
        return ""

    @property
    def status(self) -> tuple[Callable[[], DiagnosticStatus], ...]:
        """Nothing: all its parts have entries of their own."""
        return ()
