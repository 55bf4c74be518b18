"""Effects of real lenses, mirrors, lamps and cameras on images, each by a name: `--disturb NAME`, or all by `--real`.

They act on the scene (`light_of`), on ideal images, 0 to 255, before the sensor's own blur and noise
(`DisturbedCamera.shown`), on its digits (`digitised`), or on the bytes of its JPEG (`encoded`). What is fixed to a
camera, as dust, is drawn once from the seed; what changes, from pair to pair. Lengths are parts of the image's width,
so that images of all sizes are disturbed alike.

A reflection in a plane is the image of the world mirrored in that plane, seen where the reflecting surface is seen:
image += share (mirrored - image). Where a surface is seen is the image of the scene with that surface white and all
others black. Reflections of reflections are left out. Polished stone, lacquered wood and wet tiles reflect by Fresnel's
equations for n = 1.5: 4 % straight down, 9 % at 60 degrees from the vertical, 25 % at 75 degrees. From a camera 0.9 m
above the floor that is 5 % at 1 m and 17 % at 3 m.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array, Mask
from calib.rig import MountedCamera
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import Floats
from omnid.simulation.rendering.surfaces import LIGHT, POSTER_GAP_M, Rectangle, Scene, Texture

REFRACTIVE_INDEX: Final = 1.5  # of glass, glazed tiles, polish and lacquer
WHITE: Final[Texture] = np.full((8, 8), 255, np.uint8)
BLACK: Final[Texture] = np.zeros((8, 8), np.uint8)


def reflectance(cosine: Floats) -> Floats:
    """Return the share of unpolarised light that is reflected, by the cosine of the angle to the normal (Fresnel)."""
    n = np.float32(REFRACTIVE_INDEX)
    inside = np.sqrt(1 - (1 - cosine**2) / n**2)
    across, along = (cosine - n * inside) / (cosine + n * inside), (n * cosine - inside) / (n * cosine + inside)
    return np.asarray((across**2 + along**2) / 2, np.float32)


def mirror_image(rectangle: Rectangle, in_plane: Rectangle) -> Rectangle:
    """Return the mirror image of a rectangle in the plane of another one."""
    n = in_plane.normal
    across = np.eye(3) - 2 * np.outer(n, n)
    origin = across @ (rectangle.origin - in_plane.origin) + in_plane.origin
    return replace(rectangle, origin=origin, edge_u=across @ rectangle.edge_u, edge_v=across @ rectangle.edge_v)


class Mirror:
    """Renders what a camera sees in a polished floor, or in a pane of glass through which the scene is seen."""

    def __init__(self, mounted: MountedCamera) -> None:
        self._mounted = mounted

    @cached_property
    def _rays(self) -> Floats:
        """The rays (H W, 3) of the pixels in the rig frame."""
        width, height = self._mounted.camera.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        rays = self._mounted.camera.lift(pixels.astype(float)) @ self._mounted.T_cam_rig[:3, :3]
        return np.nan_to_num(rays).astype(np.float32)

    def reflected(self, image: Floats, scene: Scene, surface: Rectangle, T_world_rig: Array, samples: int) -> Floats:
        """Return the ideal image (H, W) of a scene with what a surface mirrors; the scene may hold it, or not."""
        # 1. The part of each pixel that shows the surface, times what it reflects at the pixel's angle.
        others = [face for face in scene.rectangles if face is not surface]
        shown = seen_part(replace(surface, texture=WHITE), others, self._mounted, T_world_rig, 1)
        if not shown.any():
            return image
        normal = (T_world_rig[:3, :3].T @ surface.normal).astype(np.float32)
        share = shown * reflectance(np.abs(self._rays @ normal).reshape(image.shape))
        # 2. The mirror image of all on this side of the surface, seen through it.
        here = T_world_rig[:3, 3] - surface.origin
        side = math.copysign(1.0, float(surface.normal @ here)) * surface.normal
        before = [face for face in others if ((face.corners - surface.origin) @ side).max() > POSTER_GAP_M]
        below = Scene(tuple(mirror_image(face, surface) for face in before))
        seen = render_grey(below, self._mounted, T_world_rig, samples)
        return np.asarray(image + share * (seen - image), np.float32)


def seen_part(
    surface: Rectangle, others: Sequence[Rectangle], mounted: MountedCamera, T_world_rig: Array, samples: int
) -> Floats:
    """Return the part (H, W) of each pixel, 0 to 1, that shows the white of a surface among others."""
    flags = Scene((surface, *(replace(face, texture=BLACK) for face in others)))
    shown = render_grey(flags, mounted, T_world_rig, samples) / np.float32(255 * surface.brightness)
    return np.asarray(np.minimum(shown, 1), np.float32)


Disturbance = Literal[
    "gloss",
    "glass",
    "windows",
    "shadows",
    "motion blur",
    "defocus",
    "chromatic",
    "flare",
    "dust",
    "drop",
    "flicker",
    "gain",
    "pattern",
    "lines",
    "jpeg",
    "restarts",
]
DISTURBANCES: Final[tuple[Disturbance, ...]] = get_args(Disturbance)

EXPOSURE_S: Final = 0.015  # of motion blur, and of lamps' flicker
SUB_EXPOSURES: Final = 3  # rendered for motion blur
DEFOCUS: Final = 0.003  # sigma of the blur at the rim; it grows with the square of the radius
CHROMATIC: Final = 0.0015  # by which red is magnified and blue is reduced
CHANNELS: Final = (0.299, 0.587, 0.114)  # of red, green and blue in grey
FLARE, FLARE_SIGMA = 0.08, 0.12  # share of the light that is spread, and how far
REFLECTION, REFLECTION_RADIUS = 0.25, 0.09  # of the camera in its mirror: how light, and how large
DUST, DUST_RADIUS = 40, (0.002, 0.008)  # specks, each of which dims by up to half
DROP_RADIUS, DROP_SIGMA = 0.05, 0.01  # of a drop of water, and of the blur in it
LAMP_HZ, FLICKER = 100.0, 0.25  # lamps on mains of 50 Hz, and how deep their light swings
LINE_S: Final = 26e-6  # from row to row: flicker shows as bands
GAIN_EVERY, GAIN_STEP = 9, 0.25  # pairs from step to step of automatic exposure, and the largest step
PATTERN_GREY, COLUMN_GREY, HOT = 1.5, 1.0, 2e-4  # sigma of pixels and columns, share of hot pixels
LINES: Final = 3  # rows of each image that repeat the row above
MCU_PX: Final = 16  # width of a coded block of 4:2:2
QUALITY: Final = (60, 91)  # of JPEG, another for each image
BROKEN: Final = 0.1  # share of the images whose JPEG is damaged
LOST_ROWS: Final = (1, 5)  # rows of blocks whose bytes are lost in it, with their restart markers


@dataclass(frozen=True, slots=True, eq=False)
class DisturbedCamera:
    """The disturbances of one camera."""

    names: frozenset[Disturbance]
    number: int  # 0: lower, 1: upper
    seed: int
    radius: Floats  # (H, W) distance from the middle of the mask, 1 at the rim
    dust: Floats  # (H, W) factor on the light
    drop: tuple[int, int]  # (u, v)
    pattern: Floats  # (H, W) grey

    @staticmethod
    def of(
        names: Collection[Disturbance], number: int, mask: Mask, size: tuple[int, int], seed: int
    ) -> DisturbedCamera:
        """Return the disturbances of a camera with that mask and image size (width, height)."""
        if not names:  # the images of most logs, whose maps would take longer than some of the images
            nothing = np.zeros((0, 0), np.float32)
            return DisturbedCamera(frozenset(), number, seed, nothing, nothing, (0, 0), nothing)
        rng = np.random.default_rng([seed, number, 31])
        width, height = size
        u, v = np.meshgrid(np.arange(width) - mask.center[0], np.arange(height) - mask.center[1])
        rim_px = min(mask.outer_px, width / 2)
        dust = np.ones((height, width))
        for _ in range(DUST):
            at, radius_px = rng.uniform(-rim_px, rim_px, 2), width * rng.uniform(*DUST_RADIUS)
            dust *= 1 - rng.uniform(0.1, 0.5) * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * radius_px**2))
        angle = rng.uniform(0, 2 * np.pi)
        drop = np.array(mask.center) + 0.6 * rim_px * np.array([np.cos(angle), np.sin(angle)])
        pattern = PATTERN_GREY * rng.standard_normal((height, width)) + COLUMN_GREY * rng.standard_normal(width)
        pattern[rng.uniform(size=pattern.shape) < HOT] += 120
        return DisturbedCamera(
            frozenset(names),
            number,
            seed,
            (np.hypot(u, v) / rim_px).astype(np.float32),
            dust.astype(np.float32),
            (int(drop[0]), int(drop[1])),
            pattern.astype(np.float32),
        )

    def times_s(self) -> list[float]:
        """Return the times at which an image is rendered, about the middle of its exposure."""
        if "motion blur" not in self.names:
            return [0.0]
        return (EXPOSURE_S * ((np.arange(SUB_EXPOSURES) + 0.5) / SUB_EXPOSURES - 0.5)).tolist()

    def shown(self, ideal: Floats, pair: int, time_s: float) -> Floats:
        """Return the light (H, W) on the sensor; time_s: of the exposure."""
        grey = ideal
        if "chromatic" in self.names:
            grey = self._chromatic(grey)
        if "defocus" in self.names:
            grey = self._defocused(grey)
        if "dust" in self.names and self.number == 1:
            grey = grey * self.dust
        if "drop" in self.names and self.number == 0:
            grey = self._behind_drop(grey)
        if "flare" in self.names:
            grey = self._flared(grey)
        rows = np.arange(grey.shape[0], dtype=np.float32)[:, None]
        if "flicker" in self.names:
            # The light of a lamp, 1 + a cos(2 pi f t), over the exposure: sinc(f T) is left of its swing.
            swing = FLICKER * np.sinc(LAMP_HZ * EXPOSURE_S)
            grey = grey * (1 + swing * np.cos(2 * np.pi * LAMP_HZ * (time_s + LINE_S * rows)))
        if "gain" in self.names:
            step = np.random.default_rng([self.seed, pair // GAIN_EVERY, 37]).uniform(-GAIN_STEP, GAIN_STEP)
            grey = grey * np.float32(1 + step)
        return np.asarray(grey, np.float32)

    def digitised(self, image: NDArray[np.uint8], pair: int) -> NDArray[np.uint8]:
        """Return the image (H, W) as the sensor's electronics deliver it."""
        if "pattern" in self.names:
            image = np.clip(np.rint(image + self.pattern), 0, 255).astype(np.uint8)
        if "lines" in self.names:
            rows = self._rng(pair).integers(1, image.shape[0], LINES)
            image = image.copy()
            image[rows] = image[rows - 1]
        return image

    def encoded(self, image: NDArray[np.uint8], pair: int) -> bytes | None:
        """Return the image as a colour JPEG of the camera's own encoder; None where it is not disturbed.

        jpeg: 4:2:0 in both cameras; restarts: 4:2:2 with a restart marker after each row of blocks, some of them lost;
        both: jpeg in the lower camera, restarts in the upper one.
        """
        if "restarts" in self.names and (self.number == 1 or "jpeg" not in self.names):
            return self._interrupted(image, pair)
        if "jpeg" not in self.names:
            return None
        return _colour_jpeg(image, int(self._rng(pair).integers(*QUALITY)), cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420)

    def _interrupted(self, image: NDArray[np.uint8], pair: int) -> bytes:
        """Return a JPEG, of which bytes between two restart markers were lost in some images, as on a bad cable."""
        rng = self._rng(pair)
        quality, is_broken, lost = int(rng.integers(*QUALITY)), rng.uniform() < BROKEN, int(rng.integers(*LOST_ROWS))
        interval = (cv2.IMWRITE_JPEG_RST_INTERVAL, -(-image.shape[1] // MCU_PX))  # one row of blocks
        data = _colour_jpeg(image, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422, *interval)
        if not is_broken:
            return data
        # In the data of a scan 0xFF is followed by 0 or by a marker (ITU T.81, B.1.1.5).
        markers = [found.start() for found in re.finditer(rb"\xff[\xd0-\xd7]", data)]
        first = int(rng.integers(len(markers) - lost))
        return data[: markers[first]] + data[markers[first + lost] :]

    def _rng(self, pair: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.number, pair, 41])

    def _chromatic(self, grey: Floats) -> Floats:
        """Return the sum of three colours, of which a lens magnifies each a little differently."""
        height, width = grey.shape
        whole = np.zeros_like(grey)
        for share, scale in zip(CHANNELS, (1 + CHROMATIC, 1.0, 1 - CHROMATIC), strict=True):
            M = np.array([[scale, 0, (1 - scale) * width / 2], [0, scale, (1 - scale) * height / 2]])
            whole += share * cv2.warpAffine(grey, M, (width, height), borderMode=cv2.BORDER_REPLICATE)
        return whole

    def _defocused(self, grey: Floats) -> Floats:
        """Return the image blurred by a sigma that grows with the square of the radius, between three blurs."""
        sigma = DEFOCUS * grey.shape[1] * np.minimum(self.radius, 1.2) ** 2
        levels = np.linspace(0, float(sigma.max()), 4)
        blurred = [grey, *(cv2.GaussianBlur(grey, (0, 0), level) for level in levels[1:])]
        at = sigma / levels[1]
        return np.asarray(sum(image * np.maximum(0, 1 - np.abs(at - k)) for k, image in enumerate(blurred)), np.float32)

    def _behind_drop(self, grey: Floats) -> Floats:
        """Return the image with a drop, in which the surroundings are small, upside down and blurred."""
        height, width = grey.shape
        radius_px = DROP_RADIUS * width
        x, y = np.meshgrid(np.arange(width) - self.drop[0], np.arange(height) - self.drop[1])
        u, v = ((centre - 3 * offset).astype(np.float32) for centre, offset in zip(self.drop, (x, y), strict=True))
        inside = cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        inside = cv2.GaussianBlur(inside, (0, 0), DROP_SIGMA * width)
        share = np.clip(radius_px - np.hypot(x, y), 0, 1)
        return np.asarray(grey + share * (inside - grey), np.float32)

    def _flared(self, grey: Floats) -> Floats:
        """Return the image with scattered light, and the light ring of a lens in the middle of its mirror."""
        spread = cv2.GaussianBlur(grey, (0, 0), FLARE_SIGMA * grey.shape[1])
        ring = np.abs(self.radius * 0.5 - REFLECTION_RADIUS) < REFLECTION_RADIUS / 4
        return np.asarray((1 - FLARE) * grey + FLARE * spread + REFLECTION * 255 * ring, np.float32)


def _colour_jpeg(image: NDArray[np.uint8], quality: int, sampling: int, *more: int) -> bytes:
    words = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling, *more]
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), words)[1].tobytes()


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
        # The front of a reflecting surface is the side from which its texture is read.
        before = [
            face
            for face in scene.rectangles
            if ((face.corners - faces[0].origin) @ faces[0].normal).min() < -IN_PLANE_M
        ]
        other_side = Scene(tuple(mirror_image(face, faces[0]) for face in before))
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
