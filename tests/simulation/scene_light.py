"""Light of rendered scenes that plain surfaces do not have: windows, cast shadows, glossy floors, glass.

A reflection in a plane is the image of the world mirrored in that plane, seen where the reflecting surface is seen:
image += share (mirrored - image). Where a surface is seen is the image of the scene with that surface white and all
others black. Reflections of reflections are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from calib.models.camera import Array
from omnid.simulation.rendering.sensor import Floats
from omnid.simulation.rendering.surfaces import LIGHT, Rectangle, Scene, Texture
from tests.simulation.disturbances import Disturbance
from tests.simulation.reflections import BLACK, WHITE

GLOSS: Final = 0.25  # share of the light that a floor reflects like a mirror
GLASS: Final = 0.12  # share that a pane of glass reflects at 55 degrees (Fresnel, n = 1.5, both faces)
WINDOW_GREY: Final = 200.0  # by which a window is lighter than white paper: it saturates
EVERY: Final = 3  # every third poster is a window, every third one is behind glass
IN_PLANE_M: Final = 0.005  # surfaces so near to a reflecting plane, or behind it, are not mirrored
SHADOW: Final = 0.4  # share of the light that a shadow takes
SHADOW_PX_PER_M: Final = 50.0
PENUMBRA_M: Final = 0.03  # sigma of a shadow's edge
ROBOT_RADIUS_M, ROBOT_HEIGHT_M = 0.2, 0.6  # a cylinder: its shadow does not depend on its yaw
CIRCLE: Final = 24  # corners of its outline
SHIFT: Final = 4  # binary digits of a corner's fraction of a pixel

Rendered = Callable[[Scene], Floats]  # returns the image (H, W) of a scene


def light_of(scene: Scene, rendered: Rendered, names: Collection[Disturbance], robot_xy_m: Array) -> Floats:
    """Return the ideal image (H, W) of a scene with those of the disturbances that belong to its light.

    robot_xy_m (2,): place in the world of the robot, which casts a shadow as the boxes do.
    """
    windows = _posters(scene, 0) if "windows" in names else frozenset[str]()
    image = _with_windows(scene, rendered, windows)
    if "shadows" in names:
        floor = scene.named("floor")
        dark = shadow_map(scene, robot_xy_m)
        image = image * (1 - SHADOW * _seen(scene, rendered, {"floor": dark}, floor.brightness))
    for faces in _reflecting(scene, names):
        share = GLOSS if faces[0].name == "floor" else GLASS
        other_side = Scene(tuple(mirrored(scene, faces[0])))
        seen = _seen(scene, rendered, {face.name: WHITE for face in faces}, faces[0].brightness)
        image = image + share * seen * (_with_windows(other_side, rendered, windows) - image)
    return np.asarray(image, np.float32)


def _reflecting(scene: Scene, names: Collection[Disturbance]) -> Iterator[list[Rectangle]]:
    """Yield the surfaces that reflect, those of one plane together."""
    if "gloss" in names:
        yield [scene.named("floor")]
    panes: dict[tuple[float, ...], list[Rectangle]] = {}
    glazed = _posters(scene, 1) if "glass" in names else frozenset[str]()
    for face in scene.rectangles:
        if face.name in glazed:
            plane = (*face.normal, face.normal @ face.origin)
            panes.setdefault(tuple(round(float(x), 3) for x in plane), []).append(face)
    yield from panes.values()


def mirrored(scene: Scene, mirror: Rectangle) -> Iterator[Rectangle]:
    """Yield the surfaces before a mirror as it shows them; its front is the side from which its texture is read."""
    n = mirror.normal
    for face in scene.rectangles:
        if ((face.corners - mirror.origin) @ n).min() < -IN_PLANE_M:
            origin = face.origin - 2 * ((face.origin - mirror.origin) @ n) * n
            u, v = (edge - 2 * (edge @ n) * n for edge in (face.edge_u, face.edge_v))
            yield replace(face, origin=origin, edge_u=u, edge_v=v)


def shadow_map(scene: Scene, robot_xy_m: Array) -> Texture:
    """Return the shadows of boxes and robot on the floor as a texture of it, 255 where it is dark."""
    floor = scene.named("floor")
    shape = (round(floor.height_m * SHADOW_PX_PER_M), round(floor.width_m * SHADOW_PX_PER_M))
    dark = np.zeros(shape, np.uint8)
    angle = np.linspace(0, 2 * np.pi, CIRCLE, endpoint=False)
    x, y = robot_xy_m[:, None] + ROBOT_RADIUS_M * np.array([np.cos(angle), np.sin(angle)])
    robot = np.concatenate([np.column_stack([x, y, 0 * x + z]) for z in (0.0, ROBOT_HEIGHT_M)])
    solids = [face.corners for face in scene.rectangles if face.name.startswith("box")]
    for points in [*solids, robot]:
        on_floor = points - points[:, 2:] / LIGHT[2] * LIGHT - floor.origin
        u = on_floor @ floor.edge_u / floor.width_m
        v = on_floor @ floor.edge_v / floor.height_m
        outline = np.rint(2**SHIFT * (np.column_stack([u, v]) * SHADOW_PX_PER_M - 0.5)).astype(np.int32)
        cv2.fillConvexPoly(dark, cv2.convexHull(outline), 255, cv2.LINE_AA, SHIFT)
    return np.asarray(cv2.GaussianBlur(dark, (0, 0), PENUMBRA_M * SHADOW_PX_PER_M), np.uint8)


def _with_windows(scene: Scene, rendered: Rendered, windows: frozenset[str]) -> Floats:
    image = rendered(scene)
    if not windows:
        return image
    return image + np.float32(WINDOW_GREY / 255) * rendered(_painted(scene, dict.fromkeys(windows, WHITE)))


def _posters(scene: Scene, first: int) -> frozenset[str]:
    return frozenset([face.name for face in scene.rectangles if face.name.startswith("poster")][first::EVERY])


def _seen(scene: Scene, rendered: Rendered, textures: dict[str, Texture], brightness: float) -> Floats:
    """Return the part (H, W) of each pixel that shows the white of these textures, 0 to 1."""
    return np.asarray(rendered(_painted(scene, textures)) / (255 * brightness), np.float32)


def _painted(scene: Scene, textures: dict[str, Texture]) -> Scene:
    """Return a scene in which the surfaces of these names have these textures, and all others are black."""
    return Scene(tuple(replace(face, texture=textures.get(face.name, BLACK)) for face in scene.rectangles))
