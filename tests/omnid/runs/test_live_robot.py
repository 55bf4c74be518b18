"""The first images of a live run: of both cameras in turn, which are closed again."""

from __future__ import annotations

from collections.abc import Iterator

from drivers.cameras.camera_state import CameraState
from drivers.frame import Camera, Frame
from omnid.runs.live import MASK_FRAMES, ConnectedRobot, first_frames


class Images:
    """A camera that never ends, and counts how often it is closed."""

    def __init__(self, camera: Camera) -> None:
        self.camera, self.closed, self.state = camera, 0, CameraState()

    def frames(self) -> Iterator[Frame]:
        seq = 0
        while True:
            yield Frame(seq, seq, self.camera, "mono8", b"\0", 1, 1)
            seq += 1

    def close(self) -> None:
        self.closed += 1


def test_the_first_images_come_in_turn_and_the_cameras_are_closed() -> None:
    opened = list[Images]()

    def open_camera(camera: Camera) -> Images:
        opened.append(Images(camera))
        return opened[-1]

    frames = list(first_frames(open_camera))
    assert [(frame.camera, frame.seq) for frame in frames[:4]] == [
        ("lower", 0),
        ("upper", 0),
        ("lower", 1),
        ("upper", 1),
    ]
    assert len(frames) == 2 * MASK_FRAMES and [camera.closed for camera in opened] == [1, 1]
    begun = ConnectedRobot(open_camera).first_frames()
    next(begun)
    begun.close()
    assert [camera.closed for camera in opened] == [1, 1, 1, 1]
