"""Names of the camera models, in files and for people."""

from __future__ import annotations

from calib.models.camera import OmniCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera, ExtendedUnifiedCamera
from calib.models.ocam import OcamCamera


def model_name(camera: OmniCamera) -> str:
    """Return the name of a camera's model, as the key `model` of files."""
    if isinstance(camera, OcamCamera):
        return "ocam"
    if isinstance(camera, DoubleSphereCamera):
        return "ds"
    if isinstance(camera, ExtendedUnifiedCamera):
        return "eucm"
    return "equidistant" if isinstance(camera, EquidistantCamera) else "omni"
