"""A polished floor shows what stands on it upside down, by Fresnel's share of the light."""

import math

import numpy as np
import pytest

from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from omnid.simulation.robot import make_robot, with_masks
from tests.simulation.reflections import Mirror, reflectance

ROBOT = make_robot(256)
RIG = with_masks(ROBOT.rig)
WALL_M = 2.0
SCENE = Scene(
    (
        Rectangle(
            np.array([-9.0, 9, 0]), np.array([18.0, 0, 0]), np.array([0, -18.0, 0]), np.zeros((8, 8), np.uint8), "floor"
        ),
        Rectangle(
            np.array([WALL_M, 3, 2.0]),
            np.array([0, -6.0, 0]),
            np.array([0, 0, -2.0]),
            np.full((8, 8), 200, np.uint8),
            "wall",
        ),
    )
)


@pytest.mark.parametrize(("angle_deg", "share"), [(0.0, 0.04), (60.0, 0.089), (75.0, 0.253), (90.0, 1.0)])
def test_the_share_is_that_of_fresnels_equations(angle_deg: float, share: float) -> None:
    cosine = np.array([math.cos(math.radians(angle_deg))], np.float32)
    assert reflectance(cosine)[0] == pytest.approx(share, abs=1e-3)


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_a_wall_is_seen_upside_down_where_the_floor_is(side: str) -> None:
    mounted = getattr(RIG, side)
    matt = render_grey(SCENE, mounted, RIG.T_base_rig, 2)
    polished = Mirror(mounted).reflected(matt, SCENE, SCENE.named("floor"), RIG.T_base_rig, 2)
    on_wall, in_floor = (WALL_M, 0.0, 0.4), (WALL_M, 0.0, -0.4)
    T_cam_base = mounted.T_cam_rig @ np.linalg.inv(RIG.T_base_rig)
    viewpoint = np.linalg.inv(T_cam_base)[:3, 3]
    grey, mirrored = (
        _grey(polished, mounted.camera.project((T_cam_base @ [*point, 1.0])[None, :3])) for point in (on_wall, in_floor)
    )
    ray = np.array(in_floor) - viewpoint
    share = reflectance(np.array([abs(ray[2]) / np.linalg.norm(ray)], np.float32))[0]
    assert _grey(matt, mounted.camera.project((T_cam_base @ [*in_floor, 1.0])[None, :3])) == 0.0
    assert mirrored == pytest.approx(share * grey, rel=0.03) and mirrored > 5
    np.testing.assert_array_equal(polished[matt > 100], matt[matt > 100])  # what stands is as it was


def _grey(image: np.ndarray, pixel: np.ndarray) -> float:
    u, v = np.rint(pixel[0]).astype(int)
    return float(image[v, u])
