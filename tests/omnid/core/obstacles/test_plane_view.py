"""Evidence of columns: where the wall and the floor are, and that what shows nothing, or a JPEG, is no evidence."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.frame import Frame, coding_steps
from omnid.core.obstacles.plane_view import PlaneView, ShownBins, floor_plane
from omnid.core.obstacles.settings import ScanSettings
from omnid.core.types.panorama import PaddedPanorama
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    PAD_PX,
    T_RECT_BASE,
    Pattern,
    courses,
    panoramas,
    ribbed,
    stains,
    striped,
    worn,
)

WALL_M = 2.0
VISIBLE = np.zeros((CYLINDER.height, CYLINDER.width), bool)
VISIBLE[8:-8] = True


def made(visible: NDArray[np.bool_] = VISIBLE) -> PlaneView:
    return PlaneView(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), ScanSettings(heights_m=(0.06, 1.3)), visible)


VIEW = made()
DISPARITIES = (VIEW.bins.numbers + 0.5) / 2


def seen(view: PlaneView, pair: tuple[PaddedPanorama, PaddedPanorama]) -> ShownBins:
    return view.shown(view.pair(*pair))


def between(near_m: float, far_m: float) -> NDArray[np.bool_]:
    """Return the bins of ranges."""
    return np.asarray((VIEW.bins.ranges_m > near_m) & (VIEW.bins.ranges_m < far_m))


def evidence(view: PlaneView, floor: Pattern, wall: Pattern, drop_m: float = 0.0) -> ShownBins:
    return seen(view, panoramas(floor, WALL_M, wall, drop_m))


def test_wall_of_courses_that_are_all_alike_is_none_farther_away_below_the_floor() -> None:
    """By another number of courses it fits farther away, but not near its foot: there the floor would be above it."""
    found = seen(VIEW, panoramas(stains, 1.2, courses))
    apart = DISPARITIES - VIEW.at_1m / 1.2
    assert (found.surface[np.abs(apart) < 2.5].max(axis=0) > 2).mean() > 0.95
    assert (found.surface[apart > 3] > 2).mean() < 0.01


@pytest.mark.parametrize(("drop_m", "others"), [(0.08, 1), (-0.08, 0)])
def test_low_steps_are_not_the_floor(drop_m: float, others: int) -> None:
    """8 cm are 0.8 to 1.4 rows of disparity at 1.2 to 1.8 m."""
    level, step = (evidence(VIEW, stains, striped, drop).levels[:, between(1.2, 1.8)] for drop in (0.0, drop_m))
    assert (level.mean(axis=2) > 1).all() and (step[others].mean(axis=1) < -1).all()


def test_a_floor_that_repeats_itself_and_falls_deep_is_no_floor_where_its_period_fits() -> None:
    """Ribs of 11 cm that lie 0.5 m lower fit as the floor does 1 to 1.25 m away; 1.3 m and farther they do not."""
    found = evidence(VIEW, ribbed, striped, 0.5)
    fits, farther = between(1.0, 1.25), between(1.3, 1.6)
    assert np.nanmean(found.floor[fits]) > 1
    assert found.levels[1, fits].mean() < 1.5 and found.levels[1, farther].mean() < -10


def test_floor_nearer_than_a_scan_that_no_direction_shows_is_not_used() -> None:
    """Who crosses it would be out of view on the way to the base; not so below hidden rows, or beside a speck."""
    shown = np.stack([VISIBLE] * 4)
    shown[1, 160:175] = shown[2, 78:96] = shown[3, 160:175, 100:400] = False  # 1.4 to 1.7 m away, the horizon, a speck
    floors_m = [made(visible).bins.ends_m[0] for visible in shown]
    assert floors_m[0] < 1.1 and floors_m[1] > 1.7 and floors_m[2:] == pytest.approx(2 * floors_m[:1])


QUALITY = 40


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
    return seen(VIEW, (lower, upper)).floor[between(1.0, 2.5)]


def _coded(panorama: PaddedPanorama, known: bool = True) -> PaddedPanorama:
    """Return a panorama whose image was a JPEG; known: with the steps of its quantisation."""
    data = cv2.imencode(".jpg", panorama.image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    steps = coding_steps(Frame(0, 0, "lower", "jpeg", data.tobytes())) if known else ()
    image = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
    return PaddedPanorama(image, PAD_PX, panorama.noise_grey, jpeg_steps=steps)
