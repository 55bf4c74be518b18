"""Names of the camera models, in files and for people."""

from __future__ import annotations

from calib.models.camera import OmniCamera
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


def is_lens(camera: OmniCamera) -> bool:
    """True for a camera that sees the world directly: its image has no hub and need not have a rim."""
    if isinstance(camera, UnifiedCamera):
        return camera.xi == 0
    return isinstance(camera, (DoubleSphereCamera, ExtendedUnifiedCamera, EquidistantCamera, EquirectangularCamera))


def sees_directly(camera: OmniCamera) -> bool:
    """True for a camera without a mirror, of whichever model."""
    return is_lens(camera) or (isinstance(camera, OcamCamera) and camera.view == "direct")
