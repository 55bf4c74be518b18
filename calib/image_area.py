"""One image that holds both views of a rig: two mirrors before one camera, the halves of a double fisheye.

Each view is calibrated in its own area of the image as if it was a camera's; the rig of the whole image has the same
cameras with their centres shifted, and masks that state which part belongs to which camera.

Where an area lies within the other one, as of two mirrors on one axis, its view is the ellipse in it, and the other
view is what lies around that ellipse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.models.camera import Mask, OmniCamera, whole_image
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig

# A side of an area, because a smaller one holds no view that could be calibrated.
MIN_SIDE_PX = 32
# Pixels on either side of the ellipse between two views that belong to neither: blur, and an area measured by eye.
BORDER_PX = 2.0


@dataclass(frozen=True, slots=True)
class ImageArea:
    """A rectangle of an image [px]."""

    left: int
    top: int
    width: int
    height: int

    def crop(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the area of an image (H, W); CalibError if it is not within it."""
        height, width = image.shape
        fits = min(self.left, self.top) >= 0 and min(self.width, self.height) >= MIN_SIDE_PX
        if not (fits and self.left + self.width <= width and self.top + self.height <= height):
            raise CalibError(
                f"area {self.left},{self.top},{self.width},{self.height}: expected left, top, width, height of at "
                f"least {MIN_SIDE_PX} px within the image, which is {width}x{height} px"
            )
        return np.ascontiguousarray(image[self.slices])

    @property
    def slices(self) -> tuple[slice, slice]:
        """Return the rows and columns of an image that are the area."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)

    def is_within(self, other: ImageArea) -> bool:
        """True if the area is a part of another one."""
        starts = other.left <= self.left and other.top <= self.top
        ends = self.left + self.width <= other.left + other.width and self.top + self.height <= other.top + other.height
        return self != other and starts and ends

    def ellipse(self, size: tuple[int, int], wider_px: float) -> NDArray[np.bool_]:
        """Return the pixels (H, W) of an image of size (width, height) in the ellipse that the area bounds."""
        u, v = np.arange(size[0]) - self.left + 0.5, np.arange(size[1]) - self.top + 0.5
        a, b = self.width / 2, self.height / 2
        x, y = (u - a) / (a + wider_px), (v - b) / (b + wider_px)
        return np.asarray(x**2 + y[:, None] ** 2 <= 1)


@dataclass(frozen=True, slots=True)
class TwoViews:
    """The areas of the lower and the upper camera's view in images of size (width, height)."""

    areas: tuple[ImageArea, ImageArea]
    size: tuple[int, int]

    @property
    def inner(self) -> int | None:
        """Return which view the other one lies around, 0 lower, 1 upper; None for views beside each other."""
        lower, upper = self.areas
        return 0 if lower.is_within(upper) else 1 if upper.is_within(lower) else None

    def shown(self, side: int) -> NDArray[np.bool_]:
        """Return the pixels (H, W) of the whole image that belong to a view, 0 lower, 1 upper."""
        pixels = np.zeros(self.size[::-1], bool)
        pixels[self.areas[side].slices] = True
        if self.inner is None:
            return pixels
        ellipse = self.areas[self.inner].ellipse(self.size, -BORDER_PX if side == self.inner else BORDER_PX)
        return pixels & (ellipse if side == self.inner else ~ellipse)

    def view(self, image: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
        """Return a view's area of the whole image (H, W) without the other view; CalibError if it is not within it.

        Around the inner view it is black, as around a mirror; in the place of the inner view it is the outer one's
        mean, so that no board is found and no hub.
        """
        area = self.areas[side]
        cropped = area.crop(image)
        if self.inner is None:
            return cropped
        own = self.shown(side)[area.slices]
        elsewhere = 0 if side == self.inner else round(float(cropped[own].mean()))
        return np.where(own, cropped, np.uint8(elsewhere))

    def of_whole_image(self, rig: Rig) -> Rig:
        """Return the rig of the whole image, of a rig whose cameras are those of the areas."""
        sides = [
            replace(
                mounted,
                camera=_moved(mounted.camera, (area.left, area.top), self.size),
                mask=self._mask(mounted, side),
            )
            for side, (mounted, area) in enumerate(zip((rig.lower, rig.upper), self.areas, strict=True))
        ]
        return replace(rig, lower=sides[0], upper=sides[1])

    def of_areas(self, rig: Rig) -> Rig:
        """Return the rig whose cameras are those of the areas, without masks, of the rig of the whole image."""
        sides = [
            replace(
                mounted,
                camera=_moved(mounted.camera, (-area.left, -area.top), (area.width, area.height)),
                mask=None,
            )
            for mounted, area in zip((rig.lower, rig.upper), self.areas, strict=True)
        ]
        return replace(rig, lower=sides[0], upper=sides[1])

    def _mask(self, mounted: MountedCamera, side: int) -> Mask:
        """Return the mask in the whole image: what belongs to a view, unless its rim alone tells it."""
        mask, area = mounted.mask or whole_image(mounted.camera), self.areas[side]
        center = (mask.center[0] + area.left, mask.center[1] + area.top)
        is_around = self.inner is not None and side != self.inner
        if mounted.mask is not None and mask.image is None and not is_around:
            return replace(mask, center=center)
        painted = np.where(self.shown(side), 255, 0).astype(np.uint8)
        if mask.image is not None:
            painted[area.slices][mask.image == 0] = 0
        return replace(mask, center=center, image=painted)


def _moved(camera: OmniCamera, offset: tuple[int, int], size: tuple[int, int]) -> OmniCamera:
    """Return the camera of an image of another size, in which its pixels lie further by an offset (u, v)."""
    u, v = (c + o for c, o in zip(camera.center, offset, strict=True))
    if isinstance(camera, UnifiedCamera):
        return replace(camera, center=(u, v), size=size)
    if isinstance(camera, OcamCamera):
        return replace(camera, center_row_column=(v, u), size=size)
    raise CalibError(f"one image of two views: expected an omni or ocam camera, found {type(camera).__name__}")
