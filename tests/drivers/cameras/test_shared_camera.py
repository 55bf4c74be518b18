"""One camera as the sources of both cameras of a rig: the same data and stamps, in two threads, to the end."""

from __future__ import annotations

import threading
from pathlib import Path

from drivers.cameras.log_camera import LogCamera, LogClock, LogImages
from drivers.cameras.shared_camera import SharedCamera
from drivers.frame import Frame
from tests.conftest import PAIRS

PATIENCE_S = 20.0


def opened(scene: Path, pace: float = 50.0) -> SharedCamera:
    images = LogImages.load(scene / "log.mcap")
    return SharedCamera(LogCamera(images, "lower", LogClock(), pace=pace, once=True))


def test_both_views_are_one_image(scene: Path) -> None:
    views = opened(scene)
    for lower, upper in zip(views.lower.frames(), views.upper.frames(), strict=False):
        assert (lower.camera, upper.camera) == ("lower", "upper")
        assert lower.data is upper.data and lower.stamp_ns == upper.stamp_ns
    assert views.lower.state is views.upper.state and views.lower.state.frames == PAIRS


def test_in_two_threads_the_upper_view_has_the_newest_frames_and_ends_with_the_lower_one(scene: Path) -> None:
    views, seen = opened(scene), list[Frame]()
    reader = threading.Thread(target=lambda: seen.extend(views.upper.frames()))
    reader.start()
    read = list(views.lower.frames())
    reader.join(PATIENCE_S)
    assert not reader.is_alive() and len(read) == PAIRS and seen
    assert seen[-1].stamp_ns == read[-1].stamp_ns, "the last frame is delivered before the end"
    assert [frame.seq for frame in seen] == sorted({frame.seq for frame in seen})


def test_closing_ends_both(scene: Path) -> None:
    views = opened(scene, pace=0.01)
    ended = [threading.Thread(target=lambda view=view: list(view.frames())) for view in (views.lower, views.upper)]
    for thread in ended:
        thread.start()
    views.upper.close()
    ended[1].join(PATIENCE_S)
    assert not ended[1].is_alive() and ended[0].is_alive()
    views.lower.close()
    ended[0].join(PATIENCE_S)
    assert not ended[0].is_alive()
