"""Comparison of the mirror's rim in images with the rim of a mask."""

from __future__ import annotations

import numpy as np
import pytest

from calib.masks.rim_check import rim_shift
from calib.models.camera import Mask


@pytest.mark.parametrize(
    ("moved", "radius", "fits"),
    [((0.0, 0.0), 100.0, True), ((8.0, 3.0), 100.0, False), ((0.0, 0.0), 94.0, False), ((2.0, 0.0), 110.0, True)],
)
def test_detects_a_moved_rim(moved: tuple[float, float], radius: float, fits: bool) -> None:
    v, u = np.indices((260, 260))
    center = (130.0 + moved[0], 128.0 + moved[1])
    grey = np.random.default_rng(0).integers(120, 200, (260, 260))
    image = np.where(np.hypot(u - center[0], v - center[1]) <= radius, grey, 5).astype(np.uint8)
    shift = rim_shift(image, Mask((130.0, 128.0), 0.0, 100.0))
    assert shift is not None and shift.fits == fits
    assert shift.moved_px == pytest.approx(moved, abs=0.5) and shift.wider_px == pytest.approx(radius - 100, abs=2.5)
    assert rim_shift(image, None) is None and rim_shift(np.zeros_like(image), Mask((130.0, 128.0), 0, 100)) is None
