"""Effects of real lenses, mirrors, lamps and cameras on images, each by a name: `--disturb NAME`, or all by `--real`.

They act on ideal images, 0 to 255, before the sensor's own blur and noise (`DisturbedCamera.shown`), on its digits
(`digitised`), or on the bytes of its JPEG (`encoded`). What is fixed to a camera, as dust, is drawn once from the seed.
Lengths are fractions of the image's width. A `FlawedSensor` has struts and a hub before it, a dark rim, and flickers.

A polished floor and a pane of glass (`Mirror`) show the image of the world mirrored in their plane, where they are seen
themselves: image += share (mirrored - image), the share by Fresnel's equations for n = 1.5: 4 % straight down, 25 % at
75 degrees from the vertical. Reflections of reflections are left out.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Final, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array, Mask
from calib.rig import MountedCamera
from omnid.simulation.rendering.ray_caster import Floats, Sensor, render_grey
from omnid.simulation.rendering.surfaces import POSTER_GAP_M, Rectangle, Scene, Texture

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
        others = [face for face in scene if face is not surface]
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


Disturbance = Literal["motion blur", "flare", "dust", "drop", "flicker", "pattern", "jpeg"]
DISTURBANCES: Final[tuple[Disturbance, ...]] = get_args(Disturbance)

EXPOSURE_S: Final = 0.015  # of motion blur, and of lamps' flicker
SUB_EXPOSURES: Final = 3  # rendered for motion blur
FLARE, FLARE_SIGMA = 0.08, 0.12  # share of the light that is spread, and how far
REFLECTION, REFLECTION_RADIUS = 0.25, 0.09  # of the camera in its mirror: how light, and how large
DUST, DUST_RADIUS = 40, (0.002, 0.008)  # specks, each of which dims by up to half
DROP_RADIUS, DROP_SIGMA = 0.05, 0.01  # of a drop of water, and of the blur in it
LAMP_HZ, FLICKER = 100.0, 0.25  # lamps on mains of 50 Hz, and how deep their light swings
LINE_S: Final = 26e-6  # from row to row: flicker shows as bands
PATTERN_GREY, COLUMN_GREY, HOT = 1.5, 1.0, 2e-4  # sigma of pixels and columns, share of hot pixels
QUALITY: Final = (60, 91)  # of JPEG, another for each image


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

    def shown(self, ideal: Floats, time_s: float) -> Floats:
        """Return the light (H, W) on the sensor; time_s: of the exposure."""
        grey = ideal
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
        return np.asarray(grey, np.float32)

    def digitised(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image (H, W) as the sensor's electronics deliver it."""
        if "pattern" in self.names:
            image = np.clip(np.rint(image + self.pattern), 0, 255).astype(np.uint8)
        return image

    def encoded(self, image: NDArray[np.uint8], pair: int) -> bytes | None:
        """Return the image as a colour JPEG (4:2:0) of the camera's own encoder; None where it is not disturbed."""
        if "jpeg" not in self.names:
            return None
        quality = int(np.random.default_rng([self.seed, self.number, pair, 41]).integers(*QUALITY))
        options = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
        colours = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        return cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, quality, *options])[1].tobytes()

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


# Sensors, and what is before them.
# Grey level of struts and hub.
FITTING_GREY = 18.0
# Samples per pixel and axis of a strut's edge.
EDGE_STEPS = 4
JPEG_QUALITY = 90


@dataclass(frozen=True, slots=True)
class FlawedSensor(Sensor):
    """A sensor and what is before it; lengths are fractions of the image's width, angles in the image."""

    is_compressed: bool = False  # the frames of a drive are JPEG, too
    vignette: float = 0.0  # how much darker the rim is, 0 to 1
    flicker: float = 0.0  # standard deviation of the brightness from frame to frame
    brightness: float = 1.0  # factor on the ideal image
    strut_angles_deg: tuple[float, ...] = ()
    strut_width: float = 0.014
    hub: float = 0.0  # radius


class MountedSensor:
    """One camera's sensor with its fixed patterns, computed once."""

    def __init__(self, sensor: Sensor, mask: Mask, size: tuple[int, int]) -> None:
        """mask, size: of the camera, whose images are (width, height)."""
        flawed, (width, height) = sensor if isinstance(sensor, FlawedSensor) else FlawedSensor(**asdict(sensor)), size
        self.sensor = flawed
        # 1. The part (H, W) of each pixel that struts and hub hide, 0 to 1; they are fixed to the camera.
        fine = (np.arange(side * EDGE_STEPS) / EDGE_STEPS - 0.5 + 0.5 / EDGE_STEPS for side in size)
        x, y = np.meshgrid(*(at - centre for at, centre in zip(fine, mask.center, strict=True)))
        hidden = np.hypot(x, y) <= flawed.hub * width if flawed.hub else np.zeros(x.shape, bool)
        for angle in np.deg2rad(flawed.strut_angles_deg):
            along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
            hidden |= (along > 0) & (np.abs(across) <= flawed.strut_width * width / 2)
        self.hidden: Floats = np.asarray(cv2.resize(hidden.astype(np.float32), size, interpolation=cv2.INTER_AREA))
        # 2. The factor (H, W) on the brightness: 1 in the middle, 1 - vignette at the rim, quadratic in the radius.
        x, y = np.meshgrid(np.arange(width) - mask.center[0], np.arange(height) - mask.center[1])
        rim_px = min(mask.outer_px, width / 2)
        self.falloff: Floats = (1 - flawed.vignette * np.minimum((x**2 + y**2) / rim_px**2, 1)).astype(np.float32)

    def expose(self, ideal: Floats, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the sensor's image (H, W) uint8 of an ideal one."""
        gain = self.sensor.brightness * max(0.0, 1 + self.sensor.flicker * float(rng.standard_normal()))
        grey = (ideal * self.falloff * np.float32(gain)) * (1 - self.hidden) + FITTING_GREY * self.hidden
        return self.sensor.expose(grey, rng)


def jpeg(image: NDArray[np.uint8]) -> bytes:
    """Return an image (H, W) as grey JPEG."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
