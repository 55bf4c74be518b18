"""Times of pixels: rows that are read one after the other, a camera that is late, and neither."""

from __future__ import annotations

import numpy as np

from omnid.core.types.pixel_times import SYNCHRONISED, PixelTimes

PIXELS = np.array([[0.0, 0.0], [3.4, 1.0], [-1.0, 9.0]])  # the last one across the seam and below the last row


def test_pixels_of_synchronised_cameras_have_the_time_of_the_stamp() -> None:
    assert SYNCHRONISED.is_synchronised
    assert not SYNCHRONISED.lower(PIXELS).any() and not SYNCHRONISED.upper(PIXELS).any()


def test_a_late_camera_and_rows_add_up() -> None:
    rows_s = np.arange(8, dtype=np.float32).reshape(2, 4)
    late, rolling = PixelTimes(0.015), PixelTimes(0.015, rows_s, 2 * rows_s)
    assert not any(times.is_synchronised for times in (late, rolling, PixelTimes(0.0, rows_s, rows_s)))
    np.testing.assert_allclose(late.upper(PIXELS), 0.015)
    assert not late.lower(PIXELS).any()
    np.testing.assert_array_equal(rolling.lower(PIXELS), [0.0, 7.0, 7.0])
    np.testing.assert_allclose(rolling.upper(PIXELS), np.array([0.0, 14.0, 14.0]) + 0.015)
