"""Rigs of one image that holds both views: the same rays, masks that tell which part is whose, and back again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.image_area import ImageArea, TwoViews
from calib.models.camera import Mask, OmniCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig

SIZE = (400, 400)
OMNI = UnifiedCamera(0.93, (-105.0, 106.2), (194.2, 200.9), SIZE, (0.01, 0.0, 1e-3, -2e-3))
OCAM = OcamCamera((-70.0, 0.0, 3e-3), (202.0, 196.0), (0.999, 2e-4, 3e-4), SIZE, "mirror", (1e-5, -2e-5))
T_UPPER = se3.transform(np.eye(3), [0.0, 0.0, -0.2])
VIEWS = TwoViews((ImageArea(20, 10, 400, 400), ImageArea(460, 30, 400, 400)), (900, 450))


def rig(mask: Mask | None) -> Rig:
    lower = MountedCamera(OMNI, np.eye(4), Mask(OMNI.center, 20.0, 180.0))
    return Rig(lower, MountedCamera(OCAM, T_UPPER, mask), topics=("/a", "/a"))


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_rays_are_those_of_the_shifted_pixels(side: str) -> None:
    whole = VIEWS.of_whole_image(rig(None))
    area = VIEWS.areas[side == "upper"]
    before: OmniCamera = getattr(rig(None), side).camera
    after: OmniCamera = getattr(whole, side).camera
    pixels = np.random.default_rng(1).uniform(60, 340, (50, 2))
    np.testing.assert_allclose(after.lift(pixels + np.array([area.left, area.top])), before.lift(pixels), atol=1e-9)
    assert after.size == (900, 450) and getattr(VIEWS.of_areas(whole), side).camera == before


def test_masks_tell_which_part_is_whose() -> None:
    struts = np.full((400, 400), 255, np.uint8)
    struts[:, 190:210] = 0
    for mask in (None, Mask(OCAM.center, 15.0, 170.0, struts)):
        whole = VIEWS.of_whole_image(rig(mask))
        assert whole.lower.mask is not None and whole.upper.mask is not None
        assert whole.lower.mask.contains(np.array([[214.2 + 100, 210.9]])).all()
        middle = np.array([[460 + 196.0 + 100, 30 + 202.0], [214.2 + 100, 210.9], [450.0, 200.0]])
        assert whole.upper.mask.contains(middle).tolist() == [True, False, False]
    assert not whole.upper.mask.contains(np.array([[460 + 200.0, 30 + 300.0]])).any(), "a strut stays one"


def test_an_area_outside_the_image_is_refused() -> None:
    image = np.arange(60 * 80, dtype=np.uint8).reshape(60, 80)
    assert ImageArea(10, 5, 40, 50).crop(image)[0, 0] == image[5, 10]
    for area in (ImageArea(50, 5, 40, 50), ImageArea(-1, 0, 40, 40), ImageArea(0, 0, 8, 40), ImageArea(0, 20, 40, 41)):
        with pytest.raises(CalibError, match="within the image, which is 80x60 px"):
            area.crop(image)


def test_lenses_of_other_models_are_refused_in_words() -> None:
    class Other:
        center, size = (1.0, 2.0), SIZE

    with pytest.raises(CalibError, match="expected an omni or ocam camera, found Other"):
        VIEWS.of_whole_image(replace(rig(None), upper=MountedCamera(Other(), T_UPPER)))  # type: ignore[arg-type]


AROUND = TwoViews((ImageArea(150, 110, 100, 80), ImageArea(0, 0, 400, 300)), (400, 300))
MIDDLE = (199.5, 149.5)  # of the inner view's ellipse, 100 px wide and 80 high
BESIDE_MIDDLE = np.array([[199.0 + 46, 149.0], [199.0 + 50, 149.0], [199.0 + 55, 149.0], [199.0, 149.0 + 45]])


@pytest.mark.parametrize("views", [AROUND, TwoViews(AROUND.areas[::-1], AROUND.size)])
def test_of_views_one_around_the_other_each_is_seen_without_the_other(views: TwoViews) -> None:
    image = np.full((300, 400), 200, np.uint8)
    image[110:190, 150:250] = 90
    before, inner = image.copy(), 0 if views == AROUND else 1
    assert views.inner == inner
    shown, around = views.view(image, inner), views.view(image, 1 - inner)
    assert shown.shape == (80, 100) and shown[40, 50] == 90 and shown[2, 2] == 0, "black as around a mirror"
    assert around.shape == (300, 400) and np.ptp(around[120:180, 170:230]) == 0 and 190 < around[150, 200] <= 200
    assert around[112, 152] == 90, "the area's corners belong to the outer view"
    assert (image == before).all()
    assert not (views.shown(0) & views.shown(1)).any()


def test_masks_of_views_one_around_the_other_tell_them_apart() -> None:
    inner = replace(OCAM, center_row_column=(39.5, 49.5), size=(100, 80))
    outer = replace(OMNI, center=MIDDLE, size=(400, 300))
    rig = Rig(MountedCamera(inner, np.eye(4), None), MountedCamera(outer, T_UPPER, Mask(MIDDLE, 0.0, 148.0)))
    whole = AROUND.of_whole_image(rig)
    assert whole.lower.mask is not None and whole.upper.mask is not None
    assert whole.lower.mask.contains(BESIDE_MIDDLE).tolist() == [True, False, False, False]
    assert whole.upper.mask.contains(BESIDE_MIDDLE).tolist() == [False, False, True, True]
    assert not whole.upper.mask.contains(np.array([[199.0 + 150, 149.0]])).any(), "the rim stays one"
    assert VIEWS.inner is None and VIEWS.shown(0)[10:410, 20:420].all()
