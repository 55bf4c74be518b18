"""Rigs of stitched images: Helvipad's files, and stacked cameras of any size."""

from __future__ import annotations

import numpy as np
import pytest

from calib.errors import CalibError
from calib.importers import helvipad_rig, stacked_rig

# As the data set has it: centimetres, and numbers of the lidar and of the lenses, which are not used.
HELVIPAD = {
    "stereo_baseline": 19.1,
    "lidar_camera_baseline": 45.0,
    "intrinsic_parameters": {"K": [[855.9, 0, 1451.2], [0, 852.77, 1451.71], [0, 0, 1]], "D": [0, 0, 0, 0]},
}


def test_rows_of_helvipad_have_the_angles_that_its_authors_compute_with() -> None:
    """Row r of the 512 lies at (1535 - 2 r) / 1920 of half a turn from the nadir; the baseline is 19.1 cm."""
    rig = helvipad_rig(HELVIPAD, "calibration.json")
    assert rig.baseline_m == pytest.approx(0.191) and rig.upper.viewpoint[2] > rig.lower.viewpoint[2]
    rows = np.array([0.0, 200, 511])
    rays = rig.lower.camera.lift(np.column_stack([np.full(3, 959.5), rows]))
    from_nadir = np.arccos(rays[:, 1])
    np.testing.assert_allclose(np.rad2deg(from_nadir), (1535 - 2 * rows) / 1920 * 180, atol=0.1)
    # The middle of the image is ahead, its right is right.
    np.testing.assert_allclose(rig.lower.T_cam_rig[:3, :3].T @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rig.lower.T_cam_rig[:3, :3].T @ [1, 0, 0], [0, -1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("values", "found"),
    [
        ({}, "stereo_baseline"),
        ({"stereo_baseline": "19"}, "stereo_baseline"),
        ({"stereo_baseline": 1910}, "expected 0.001 to 5.0 m"),
        ({"stereo_baseline": float("nan")}, "expected 0.001 to 5.0 m"),
    ],
)
def test_other_files_are_refused(values: dict[str, object], found: str) -> None:
    with pytest.raises(CalibError, match=found):
        helvipad_rig(values, "calibration.json")


def test_images_of_other_sizes_are_refused() -> None:
    with pytest.raises(CalibError, match="twice as many columns as rows"):
        stacked_rig((1920, 900), 0.2)
