"""Evidence of columns: where the wall and the floor are, and that what shows nothing, or noise, is no evidence."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drivers.frame import Frame, coding_steps
from omnid.config import PanoramaConfig
from omnid.core.obstacles.panoramas import DIRECTIONS, UNITS, WorkingPanoramas
from omnid.core.obstacles.stereo import NEAREST_M, Columns, StereoEvidence, floor_plane
from omnid.core.obstacles.stereo_kernels import PART
from omnid.core.types.panorama import PaddedPanorama
from omnid.messages import FramePair
from omnid.simulation.robot import make_robot
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import geometry
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    HEIGHT_M,
    PAD_PX,
    T_RECT_BASE,
    Pattern,
    courses,
    panoramas,
    plain,
    ribbed,
    stains,
    striped,
    worn,
)

WALL_M = 2.0
QUALITY = 40  # of JPEGs
NOISE_GREY = 3.0
FLOOR_ROWS = slice(40, 110)  # below the horizon: 16 to 38 degrees
VISIBLE = np.zeros((CYLINDER.height, CYLINDER.width), bool)
VISIBLE[8:-8] = True


@pytest.fixture(scope="module")
def columns() -> Columns:
    return Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), (0.06, 1.3), (NEAREST_M, 6.0), VISIBLE)


def evidence(columns: Columns, floor: Pattern, wall: Pattern, drop_m: float = 0.0) -> StereoEvidence:
    return columns.evidence(columns.panoramas.pair(*panoramas(floor, WALL_M, wall, drop_m)))


def bins(columns: Columns, near_m: float, far_m: float) -> slice:
    """Return the disparities of floor between two ranges."""
    return slice(int(columns.at_1m / far_m), int(columns.at_1m / near_m))


def test_floor_plane_of_an_upright_rig_is_level() -> None:
    assert floor_plane(T_RECT_BASE) == pytest.approx((HEIGHT_M, 0.0, 0.0))


def test_parts_of_directions_are_whole() -> None:
    """The loops over a part do not ask where the directions end."""
    assert DIRECTIONS % PART == 0


def test_wall_and_the_floor_before_it_are_found_in_all_directions(columns: Columns) -> None:
    found = evidence(columns, stains, striped)
    assert (np.abs(np.argmax(found.surface, axis=0) - columns.at_1m / WALL_M) <= 1.5).mean() > 0.95
    assert (found.level[:, bins(columns, 1.1, 1.6)] > 1).mean() > 0.9
    assert (found.surface[int(columns.at_1m / 1.5) :] > 2).mean() < 0.01


def test_wall_of_courses_that_are_all_alike_is_none_farther_away_below_the_floor(columns: Columns) -> None:
    """By another number of courses it fits farther away, but not near its foot: there the floor would be above it."""
    found = columns.evidence(columns.panoramas.pair(*panoramas(stains, 1.2, courses)))
    at = round(columns.at_1m / 1.2)
    assert (found.surface[at - 2 : at + 3].max(axis=0) > 2).mean() > 0.95
    assert (found.surface[at + 3 :] > 2).mean() < 0.01


def test_floor_of_weak_texture_is_weak_evidence_for_the_floor(columns: Columns) -> None:
    """Stains of 3 grey levels with noise of 1 say less than strong ones, and the right thing."""
    near = bins(columns, 1.1, 1.6)
    weak, strong = (evidence(columns, floor, striped).level[:, near] for floor in (worn, stains))
    assert 1.0 < weak.mean() < 0.8 * strong.mean()


def test_plain_wall_and_plain_floor_are_no_evidence(columns: Columns) -> None:
    """The best of thirty planes fits noise better than the floor does."""
    found = evidence(columns, plain, plain)
    assert (np.abs(found.level[:, bins(columns, 1.0, 1.6)].mean(axis=(1, 2))) < 0.6).all()
    assert np.percentile(found.surface, 99.5) < 2


@pytest.mark.parametrize(("drop_m", "others"), [(0.08, 1), (-0.08, 0)])
def test_low_steps_are_not_the_floor(columns: Columns, drop_m: float, others: int) -> None:
    """8 cm are 0.8 to 1.4 rows of disparity at 1.2 to 1.8 m."""
    near = bins(columns, 1.2, 1.8)
    level, step = (evidence(columns, stains, striped, drop).level[:, near] for drop in (0.0, drop_m))
    assert (level.mean(axis=2) > 1).all() and (step[others].mean(axis=1) < -1).all()


def test_a_floor_that_repeats_itself_and_falls_deep_is_no_floor_where_its_period_fits(columns: Columns) -> None:
    """Ribs of 11 cm that lie 0.5 m lower fit as the floor does 1 to 1.25 m away; 1.3 m and farther they do not."""
    found = evidence(columns, ribbed, striped, 0.5)
    fits, farther = bins(columns, 1.0, 1.25), bins(columns, 1.3, 1.6)
    assert found.level[1, fits].mean() < 1.5 and found.level[1, farther].mean() < -10


def test_lost_pixels_are_no_evidence(columns: Columns) -> None:
    lost = np.zeros((CYLINDER.height, CYLINDER.width), bool)
    lost[:, 400:] = True
    found = columns.evidence(columns.panoramas.pair(*panoramas(stains, WALL_M, striped), lost))
    first = int(400 / CYLINDER.width * DIRECTIONS) + 2
    gone = slice(first, DIRECTIONS - 2)
    assert not found.surface[:, gone].any() and not found.level[:, :, first + 3 : DIRECTIONS - 5].any()
    assert found.surface[:, : first - 4].any()


def test_cameras_that_see_no_floor_have_no_evidence_of_it() -> None:
    visible = np.zeros_like(VISIBLE)
    visible[8:90] = True
    columns = Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), (0.06, 1.3), (NEAREST_M, 6.0), visible)
    found = columns.evidence(columns.panoramas.pair(*panoramas(stains, WALL_M, striped)))
    assert not found.level.any()


def test_floor_nearer_than_a_scan_that_no_direction_shows_is_not_used() -> None:
    """People who cross the scan would be out of view on their way to the base."""
    visible = VISIBLE.copy()
    visible[160:175] = False  # 1.4 to 1.7 m away
    whole, cut = (
        Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), (0.06, 1.3), (NEAREST_M, 6.0), shown)
        for shown in (VISIBLE, visible)
    )
    # Floor below rows of the horizon that are hidden is seen as before, and so is that beside a speck.
    horizon, speck = VISIBLE.copy(), VISIBLE.copy()
    horizon[78:96] = False
    speck[160:175, 100:400] = False
    others = (
        Columns(CYLINDER, BASELINE_M, floor_plane(T_RECT_BASE), (0.06, 1.3), (NEAREST_M, 6.0), shown)
        for shown in (horizon, speck)
    )
    floors_m = [one.at_1m / np.flatnonzero(_levels_of(one).any(axis=(0, 2))).max() for one in (whole, cut, *others)]
    assert floors_m[0] < 1.1 and floors_m[1] > 1.7 and floors_m[2:] == pytest.approx(2 * floors_m[:1])


def _levels_of(columns: Columns) -> np.ndarray:
    """Return the evidence (2, K, DIRECTIONS) of a floor with stains."""
    return columns.evidence(columns.panoramas.pair(*panoramas(stains, WALL_M, striped))).level


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
    views = working.views(working.pair(pair.lower, pair.upper))
    difference = (views.lower.astype(float) - views.upper)[round(working.row0) :][FLOOR_ROWS]
    assert least < difference.std() / UNITS < 1.05


def test_a_floor_in_jpegs_is_no_evidence_against_itself(columns: Columns) -> None:
    """Their errors extend over blocks and look like another disparity, unless they count as noise."""
    pair = panoramas(worn, 6.0, striped)
    pairs = pair, [_coded(one) for one in pair], [_coded(one, known=False) for one in pair]
    clean, coded, unknown = (columns.evidence(columns.panoramas.pair(*each)).level[0] for each in pairs)
    near = bins(columns, 1.0, 2.5)
    against = [float((level[near] < -2).mean()) for level in (clean, coded, unknown)]
    assert against[0] <= against[1] < 0.02 < against[2]
    assert np.median(coded[near]) < np.median(clean[near])


def _coded(panorama: PaddedPanorama, known: bool = True) -> PaddedPanorama:
    """Return a panorama whose image was a JPEG; known: with the steps of its quantisation."""
    data = cv2.imencode(".jpg", panorama.image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    steps = coding_steps(Frame(0, 0, "lower", "jpeg", data.tobytes())) if known else ()
    image = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
    return PaddedPanorama(image, PAD_PX, panorama.noise_grey, jpeg_steps=steps)
