"""The image of the posterior shows free floor around the base, and ends it at what stands there."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from tests.experiments.obstacle_posterior import image as posterior


def test_floor_is_free_around_the_base_and_unknown_beyond_a_white_wall(tmp_path: Path) -> None:
    posterior.write(tmp_path / "a.png", ("white wall",), steps=20, size_px=384)
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None
    states = image[image.shape[0] // 2 :]
    free, unknown = (
        np.argwhere(np.abs(states.astype(int) - color[::-1]).max(axis=2) < 6).mean(axis=0)
        for color in ((159, 211, 159), (191, 191, 191))
    )
    assert free[1] + 50 < unknown[1]  # the base drives to the right
