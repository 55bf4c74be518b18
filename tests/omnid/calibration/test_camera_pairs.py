"""Pairs of images from two cameras that view a scene that does not move."""

from __future__ import annotations

import time
from importlib.resources import files
from itertools import islice
from pathlib import Path

import numpy as np

from drivers.cameras.log_camera import LogCamera, LogClock, LogImages
from drivers.frame import gray
from omnid.calibration.camera_pairs import newest_pairs

SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))


def test_pairs_of_cameras_are_the_newest() -> None:
    images, clock = LogImages.load(SAMPLE), LogClock()
    lower, upper = (LogCamera(images, side, clock) for side in ("lower", "upper"))
    begin_s, pairs = time.monotonic(), newest_pairs(lower, upper)
    for _ in islice(pairs, 3):
        time.sleep(0.35)  # more than three images of each camera, which must not wait in a queue
    assert time.monotonic() - begin_s > 1.0
    one, _ = next(pairs)
    lower.close()
    upper.close()
    elapsed_ns = (time.monotonic() - begin_s) * 1e9
    shown = next(frame for _, frame in images.lower if np.array_equal(gray(frame), one))
    first_ns = images.lower[0][1].stamp_ns
    assert 0.9e9 < shown.stamp_ns - first_ns < elapsed_ns
