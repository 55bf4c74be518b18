"""Noise of working panoramas, of the sensor and of a JPEG, against the differences that images really have."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.frame import Frame, coding_steps
from omnid.config import PanoramaConfig
from omnid.core.obstacles.column import Columns, FloorPlane
from omnid.core.obstacles.panoramas import UNITS, WorkingPanoramas
from omnid.core.types.panorama import PaddedPanorama
from omnid.messages import FramePair
from omnid.simulation.robot import make_robot
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import geometry
from tests.omnid.core.obstacles.drawn_floor import BASELINE_M, CYLINDER, HEIGHT_M, PAD_PX, panoramas, striped, worn

QUALITY = 40
NOISE_GREY = 3.0
FLOOR_ROWS = slice(40, 110)  # below the horizon: 16 to 38 degrees
VISIBLE = np.ones((CYLINDER.height, CYLINDER.width), bool)
COLUMNS = Columns(CYLINDER, BASELINE_M, FloorPlane(HEIGHT_M, 0.0, 0.0), (0.06, 1.2), (0.5, 4.0), VISIBLE)


@pytest.mark.parametrize(("size_px", "least"), [(512, 0.8), (960, 0.5)])
def test_two_views_of_nothing_but_noise_differ_by_one_sigma_in_the_rows_of_the_floor(
    size_px: int, least: float
) -> None:
    """Finer images have less noise left, so that the stated share is the largest."""
    place = geometry(make_robot(size_px).rig, PanoramaConfig())
    rng = np.random.default_rng(5)
    images = (np.clip(np.rint(120 + rng.normal(0, NOISE_GREY, (size_px, size_px))), 0, 255) for _ in range(2))
    pair = Dewarp(place, PanoramaConfig()).process(FramePair(0, 0, *(image.astype(np.uint8) for image in images)))
    working = WorkingPanoramas(
        place.cylinder, (0.0, 0.0), 0.2, np.ones((place.cylinder.height, place.cylinder.width), bool)
    )
    for views in working.views(working.pair(pair.lower, pair.upper)):
        difference = (views.lower.astype(float) - views.upper)[round(working.row0) :][FLOOR_ROWS]
        assert least < difference.std() / UNITS < 1.05


def test_a_floor_in_jpegs_is_no_evidence_against_itself() -> None:
    """Their errors extend over blocks and look like another disparity, unless they count as noise."""
    pair = panoramas(worn, 6.0, striped)
    clean, coded = _floor(*pair), _floor(*map(_coded, pair))
    unknown = _floor(*(_coded(panorama, known=False) for panorama in pair))
    against = [float((floor < -2).mean()) for floor in (clean, coded, unknown)]
    assert against[1] < 0.005 < 0.02 < against[2]
    assert against[0] <= against[1] and np.median(coded) < np.median(clean)


def _floor(lower: PaddedPanorama, upper: PaddedPanorama) -> NDArray[np.float32]:
    """Return the evidence of the floor from 1 to 2.5 m."""
    ranges_m = COLUMNS.at_1m / (np.arange(COLUMNS.bins) + 0.5)
    floor = COLUMNS.evidence(COLUMNS.panoramas.pair(lower, upper)).floor[(ranges_m > 1.0) & (ranges_m < 2.5)]
    return np.asarray(floor[np.isfinite(floor)])


def _coded(panorama: PaddedPanorama, known: bool = True) -> PaddedPanorama:
    """Return a panorama whose image was a JPEG; known: with the steps of its quantisation."""
    data = cv2.imencode(".jpg", panorama.image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    steps = coding_steps(Frame(0, 0, "lower", "jpeg", data.tobytes())) if known else ()
    image = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
    return PaddedPanorama(image, PAD_PX, panorama.noise_grey, jpeg_steps=steps)
