"""One image that holds both views of a rig: two mirrors before one camera, the halves of a double fisheye.

Each view is calibrated in its own area of the image as if it was a camera's; the rig of the whole image has the same
cameras with their centres shifted, and masks that state which part belongs to which camera.
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
        bottom, right = self.top + self.height, self.left + self.width
        return np.ascontiguousarray(image[self.top : bottom, self.left : right])


@dataclass(frozen=True, slots=True)
class TwoViews:
    """The areas of the lower and the upper camera's view in images of size (width, height)."""

    areas: tuple[ImageArea, ImageArea]
    size: tuple[int, int]

    def of_whole_image(self, rig: Rig) -> Rig:
        """Return the rig of the whole image, of a rig whose cameras are those of the areas."""
        sides = [
            replace(
                mounted,
                camera=_moved(mounted.camera, (area.left, area.top), self.size),
                mask=self._mask(mounted, area),
            )
            for mounted, area in zip((rig.lower, rig.upper), self.areas, strict=True)
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

    def _mask(self, mounted: MountedCamera, area: ImageArea) -> Mask:
        """Return the mask in the whole image. An unknown or painted mask shows nothing outside of the area."""
        mask = mounted.mask or whole_image(mounted.camera)
        center = (mask.center[0] + area.left, mask.center[1] + area.top)
        if mounted.mask is not None and mask.image is None:
            return replace(mask, center=center)
        painted = np.zeros(self.size[::-1], np.uint8)
        inside = np.full((area.height, area.width), 255, np.uint8) if mask.image is None else mask.image
        painted[area.top : area.top + area.height, area.left : area.left + area.width] = inside
        return replace(mask, center=center, image=painted)


def _moved(camera: OmniCamera, offset: tuple[int, int], size: tuple[int, int]) -> OmniCamera:
    """Return the camera of an image of another size, in which its pixels lie further by an offset (u, v)."""
    u, v = (c + o for c, o in zip(camera.center, offset, strict=True))
    if isinstance(camera, UnifiedCamera):
        return replace(camera, center=(u, v), size=size)
    if isinstance(camera, OcamCamera):
        return replace(camera, center_row_column=(v, u), size=size)
    raise CalibError(f"one image of two views: expected an omni or ocam camera, found {type(camera).__name__}")
