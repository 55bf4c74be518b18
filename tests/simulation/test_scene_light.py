"""Tests of the light of scenes: reflections, windows and shadows are where they belong, and nowhere else."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
import pytest

from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import Floats
from omnid.simulation.rendering.surfaces import LIGHT, Rectangle, Scene
from tests.simulation import SimulatedRun, build
from tests.simulation.disturbances import Disturbance
from tests.simulation.scene_light import BLACK, GLOSS, SHADOW, WHITE, light_of, mirrored, shadow_map

SIDE: Final = 160


@cache
def run() -> SimulatedRun:
    return build("rooms", 3, SIDE, 4)


def rendered(scene: Scene) -> Floats:
    return render_grey(scene, run().rig.lower, run().poses[0])


@cache
def clean() -> Floats:
    return rendered(run().scene)


def lit(*names: Disturbance) -> Floats:
    return light_of(run().scene, rendered, names, run().poses[0][:2, 3])


def shown(prefix: str) -> np.ndarray:
    """Return the mask (H, W) of pixels that show surfaces whose name starts so."""
    faces = run().scene.rectangles
    textures = [WHITE if face.name.startswith(prefix) else BLACK for face in faces]
    painted = (
        Rectangle(face.origin, face.edge_u, face.edge_v, texture, face.name)
        for face, texture in zip(faces, textures, strict=True)
    )
    return rendered(Scene(tuple(painted))) > 0


def test_a_glossy_floor_shows_the_room_upside_down() -> None:
    changed, on_floor = np.abs(lit("gloss") - clean()) > 1e-3, shown("floor")
    assert changed[on_floor].mean() > 0.3 and not changed[~on_floor].any()
    assert np.abs(lit("gloss") - clean()).max() <= 255 * GLOSS


def test_a_reflection_is_where_the_mirror_image_of_its_object_is() -> None:
    """A pane in the plane x = 2 shows what is at x = 0.5 at x = 3.5, and nothing of what is behind it."""
    across, down = np.array([0, -1.0, 0]), np.array([0, 0, -1.0])
    pane = Rectangle(np.array([2.0, 0.5, 1.5]), across, down, BLACK, "poster1")
    before, behind = (Rectangle(np.array([x, 0.2, 1.2]), across, down, WHITE, "box") for x in (0.5, 2.5))
    (image,) = mirrored(Scene((pane, before, behind)), pane)
    assert image.corners == pytest.approx(before.corners * [-1, 1, 1] + [4, 0, 0])


def test_shadows_lie_on_the_floor_away_from_the_light_and_follow_the_robot() -> None:
    share = lit("shadows") / np.maximum(clean(), 1)
    dark, on_floor = (share < 0.99) & (clean() > 1), shown("floor")
    assert dark[on_floor].any() and not dark[~on_floor].any() and share[clean() > 1].min() > 0.99 - SHADOW

    floor = run().scene.named("floor")
    empty = Scene((floor,))
    centres = []
    for x_m, y_m in ((0.0, 0.0), (0.101, 0.203)):
        rows, columns = np.nonzero(shadow := shadow_map(empty, np.array([x_m, y_m])))
        weights = shadow[rows, columns]
        uv = np.column_stack([columns + 0.5, rows + 0.5]) / [shadow.shape[1], shadow.shape[0]]
        centres.append(np.average(floor.points(uv), axis=0, weights=weights)[:2])
    assert centres[1] - centres[0] == pytest.approx([0.101, 0.203], abs=0.003)
    # The middle of a shadow is that of the cylinder, half its height above the floor, along the light.
    assert centres[0] == pytest.approx(-0.3 * LIGHT[:2] / LIGHT[2], abs=0.01)
