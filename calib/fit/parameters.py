"""Parameters of cameras in fits: the names that are fitted, and one step of each, which moves the image by a pixel."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.names import changed, is_coefficient, values_of
from calib.models.ocam import ASTIGMATISM_NAMES, TANGENTIAL_NAMES, OcamCamera
from calib.models.unified import OMNI_NAMES, UnifiedCamera
from calib.models.wavefront import WAVEFRONT_NAMES

# One step of a wavefront's coefficient [m], so that it moves a board at half a metre by about half a pixel, as steps of
# the other parameters do.
WAVEFRONT_UNIT_M = 1e-3


def central_names(camera: OmniCamera, distortion: Collection[str] = ()) -> tuple[str, ...]:
    """Return the parameters of a camera without its wavefront: all, and of distortion and polynomial the terms not 0.

    distortion: terms of an omni camera that are parameters although they are 0. CalibError for other models.
    """
    values = values_of(camera)
    if isinstance(camera, UnifiedCamera):
        return tuple(name for name in OMNI_NAMES if name in (*OMNI_NAMES[:5], *distortion) or values[name] != 0)
    if not isinstance(camera, OcamCamera):
        raise CalibError(
            f"calibrate: expected an omni or ocam camera, whose parameters can be fitted, found "
            f"{type(camera).__name__}: calibrate lenses by Kalibr"
        )
    names = [name for name in values if is_coefficient(name) and values[name] != 0]
    names += ["center_row", "center_column", "c", "d"]  # e moves along with d
    # p1 and p2 are correlated, so both are fitted or neither.
    names += TANGENTIAL_NAMES if any(camera.tangential) else ()
    return (*names, *(ASTIGMATISM_NAMES if any(camera.astigmatism) else ()))


def units_of(camera: OmniCamera, names: Sequence[str]) -> Array:
    """Return one step (P,) of the named parameters of an omni or ocam camera, in their own units."""
    scale = min(camera.size) / 2
    units = dict.fromkeys((*OMNI_NAMES[1:5], "center_row", "center_column"), 1.0)
    units |= dict.fromkeys(WAVEFRONT_NAMES, WAVEFRONT_UNIT_M)
    if isinstance(camera, OcamCamera):
        units |= dict.fromkeys(TANGENTIAL_NAMES, scale**-2) | dict.fromkeys(ASTIGMATISM_NAMES, scale**-3)
        units |= {name: scale ** -float(name[1:]) for name in names if is_coefficient(name)}
    return np.array([units.get(name, 1 / scale) for name in names])


def stepped(camera: OmniCamera, names: Sequence[str], steps: Array) -> OmniCamera:
    """Return the camera after steps (P,) of its named parameters; CalibError where that is no camera."""
    return changed(camera, dict(zip(names, (steps * units_of(camera, names)).tolist(), strict=True)))
