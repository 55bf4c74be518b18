"""Camera parameterisation: scaled steps about a camera's parameters, one unit moving the image by about a pixel."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import ASTIGMATISM_NAMES, TANGENTIAL_NAMES, OcamCamera
from calib.models.unified import OMNI_NAMES, UnifiedCamera
from calib.models.wavefront import WAVEFRONT_NAMES

# One step of a wavefront's coefficient [m], so that it moves a board at half a metre by about half a pixel, as steps of
# the other parameters do.
WAVEFRONT_UNIT_M = 1e-3
# A parameter: its name, its value, and one step in its own unit.
_Row = tuple[str, float, float]


@dataclass(frozen=True, slots=True)
class CameraParameterisation:
    """Local parameterisation of a camera by steps (P,): camera_at() makes a camera, plain_values() its parameters."""

    base: OmniCamera
    names: tuple[str, ...]
    start: Array  # (P,) the base's parameters
    units: Array  # (P,) one step in the parameters' own units

    def camera_at(self, steps: Array) -> OmniCamera:
        """Return the camera at the steps; raises CalibError if its parameters are not those of a camera."""
        values = dict(zip(self.names, self.plain_values(steps).tolist(), strict=True))
        if isinstance(self.base, UnifiedCamera):
            return _omni_camera(self.base, values)
        return _ocam_camera(self.base, values)

    def plain_values(self, steps: Array) -> Array:
        """Return the parameters (P,) at the steps in their own units."""
        return self.start + steps * self.units

    def plain_by_steps(self, steps: Array) -> Array:
        """Return the derivatives (P, P) of the plain values by the steps."""
        return np.diag(self.units)


def parameterise(
    camera: OmniCamera, distortion: Collection[str] = (), *, wavefront: bool = False
) -> CameraParameterisation:
    """Return the parameterisation about a camera: all parameters, and of distortion and polynomial the terms not 0.

    distortion: names of an omni camera's terms that are parameters although they are 0. wavefront: with the terms of an
    ocam camera's wavefront, and its secondary astigmatism, even if they are 0. Without, the wavefront stays: only near
    objects such as boards show it.
    """
    if isinstance(camera, UnifiedCamera):
        rows = _omni_rows(camera, distortion)
    elif isinstance(camera, OcamCamera):
        rows = _ocam_rows(camera, wavefront=wavefront)
    else:
        raise CalibError(
            f"calibrate: expected an omni or ocam camera, whose parameters can be fitted, found "
            f"{type(camera).__name__}: calibrate lenses by Kalibr"
        )
    names, start, units = zip(*rows, strict=True)
    return CameraParameterisation(camera, names, np.array(start), np.array(units))


def _omni_rows(camera: UnifiedCamera, distortion: Collection[str]) -> list[_Row]:
    scale = min(camera.size) / 2
    values = (camera.xi, *camera.focal, *camera.center, *camera.distortion)
    pixels = OMNI_NAMES[1:5]  # the others have no unit
    rows = [(name, value, 1.0 if name in pixels else 1 / scale) for name, value in zip(OMNI_NAMES, values, strict=True)]
    kept = ("xi", *pixels, *distortion)
    return [row for row in rows if row[1] != 0 or row[0] in kept]


def _ocam_rows(camera: OcamCamera, *, wavefront: bool) -> list[_Row]:
    scale = min(camera.size) / 2
    rows = [(f"a{power}", value, scale ** -float(power)) for power, value in enumerate(camera.polynomial) if value != 0]
    rows += _rows(("center_row", "center_column"), camera.center_row_column, 1.0)
    rows += _rows(("c", "d"), camera.affine[:2], 1 / scale)
    # p1 and p2 are correlated, so both are adjusted or neither.
    if any(camera.tangential):
        rows += _rows(TANGENTIAL_NAMES, camera.tangential, 1 / scale**2)
    if wavefront or any(camera.astigmatism):
        rows += _rows(ASTIGMATISM_NAMES, camera.astigmatism, 1 / scale**3)
    if wavefront:
        rows += _rows(WAVEFRONT_NAMES, camera.wavefront, WAVEFRONT_UNIT_M)
    return rows


def _rows(names: Iterable[str], values: Iterable[float], unit: float) -> list[_Row]:
    return [(name, value, unit) for name, value in zip(names, values, strict=True)]


def _omni_camera(base: UnifiedCamera, values: dict[str, float]) -> UnifiedCamera:
    xi, fu, fv, pu, pv = (values[name] for name in OMNI_NAMES[:5])
    k1, k2, p1, p2 = (values.get(name, 0.0) for name in OMNI_NAMES[5:])
    return replace(base, xi=xi, focal=(fu, fv), center=(pu, pv), distortion=(k1, k2, p1, p2))


def _ocam_camera(base: OmniCamera, values: dict[str, float]) -> OcamCamera:
    """Return the camera of named values. d and e move together: their difference equals a rotation of the camera."""
    assert isinstance(base, OcamCamera)
    polynomial = tuple(values.get(f"a{power}", 0.0) for power in range(len(base.polynomial)))
    affine = (values["c"], values["d"], base.affine[2] + values["d"] - base.affine[1])
    p1, p2 = (values.get(name, 0.0) for name in TANGENTIAL_NAMES)
    s1, s2 = (values.get(name, 0.0) for name in ASTIGMATISM_NAMES)
    wavefront = tuple(values.get(name, now) for name, now in zip(WAVEFRONT_NAMES, base.wavefront, strict=True))
    return replace(
        base,
        polynomial=polynomial,
        center_row_column=(values["center_row"], values["center_column"]),
        affine=affine,
        tangential=(p1, p2),
        astigmatism=(s1, s2),
        wavefront=wavefront,
    )
