"""Names of the camera models, in files and for people; which of them see directly, and how much of their images."""

from __future__ import annotations

from calib.models.camera import Mask, OmniCamera, inscribed_mask, whole_image
from calib.models.equirectangular import EquirectangularCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera, ExtendedUnifiedCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera


def model_name(camera: OmniCamera) -> str:
    """Return the name of a camera's model, as the key `model` of files."""
    if isinstance(camera, OcamCamera):
        return "ocam"
    if isinstance(camera, DoubleSphereCamera):
        return "ds"
    if isinstance(camera, ExtendedUnifiedCamera):
        return "eucm"
    if isinstance(camera, EquirectangularCamera):
        return "equirectangular"
    return "equidistant" if isinstance(camera, EquidistantCamera) else "omni"


def model_in_words(camera: OmniCamera) -> str:
    """Return the name of a camera's model, and the view of one that may be a mirror's or a lens's."""
    return f"ocam, {camera.view} view" if isinstance(camera, OcamCamera) else model_name(camera)


def sees_directly(camera: OmniCamera) -> bool:
    """True for a camera without a mirror, of whichever model: its image has no hub and need not have a rim."""
    if isinstance(camera, OcamCamera):
        return camera.view == "direct"
    if isinstance(camera, UnifiedCamera):
        return camera.xi == 0 or camera.focal[0] * camera.focal[1] > 0  # a mirror flips its image
    return True


def visible_part(camera: OmniCamera) -> Mask:
    """Return the mask if none is known: the whole image of a lens, and the largest disc in that of a mirror."""
    return whole_image(camera) if sees_directly(camera) else inscribed_mask(camera)
