"""Camera parameterisation: scaled steps about a camera's parameters, one unit moving the image by about a pixel."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.derivatives import pixel_derivatives
from calib.models.ocam import ASTIGMATISM_NAMES, TANGENTIAL_NAMES, OcamCamera
from calib.models.unified import OMNI_NAMES, UnifiedCamera
from calib.models.wavefront import WAVEFRONT_NAMES

# One step of a wavefront's coefficient [m], so that it moves a board at half a metre by about half a pixel, as steps of
# the other parameters do.
WAVEFRONT_UNIT_M = 1e-3
# Centre and affine of an ocam camera; e moves along with d.
OCAM_NAMES = ("center_row", "center_column", "c", "d")


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

    def derivatives(self, steps: Array, points: Array) -> tuple[Array, Array]:
        """Return the derivatives of the camera's pixels by points (N, 3), (N, 2, 3), and by the steps, (N, 2, P)."""
        by_point, by_plain = pixel_derivatives(self.camera_at(steps), points, self.names)
        return by_point, by_plain * self.units

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
        kept = ("xi", *OMNI_NAMES[1:5], *distortion)
        chosen = [name for name, value in _values(camera).items() if value != 0 or name in kept]
    elif isinstance(camera, OcamCamera):
        values = _values(camera)
        chosen = [name for name in values if name[0] == "a" and name[1:].isdigit() and values[name] != 0]
        chosen += OCAM_NAMES
        # p1 and p2 are correlated, so both are adjusted or neither.
        chosen += TANGENTIAL_NAMES if any(camera.tangential) else ()
        chosen += ASTIGMATISM_NAMES if wavefront or any(camera.astigmatism) else ()
        chosen += WAVEFRONT_NAMES if wavefront else ()
    else:
        raise CalibError(
            f"calibrate: expected an omni or ocam camera, whose parameters can be fitted, found "
            f"{type(camera).__name__}: calibrate lenses by Kalibr"
        )
    return with_names(camera, chosen)


def with_names(camera: UnifiedCamera | OcamCamera, names: Sequence[str]) -> CameraParameterisation:
    """Return the parameterisation about a camera by the named parameters, also those that are 0."""
    if isinstance(camera, OcamCamera):
        highest = max(int(name[1:]) for name in names if name[0] == "a" and name[1:].isdigit())
        missing = highest + 1 - len(camera.polynomial)
        camera = replace(camera, polynomial=(*camera.polynomial, *[0.0] * max(0, missing)))
    values, scale = _values(camera), min(camera.size) / 2
    units = [_unit(name, scale, is_omni=isinstance(camera, UnifiedCamera)) for name in names]
    return CameraParameterisation(camera, tuple(names), np.array([values[name] for name in names]), np.array(units))


def _values(camera: UnifiedCamera | OcamCamera) -> dict[str, float]:
    """Return all parameters by name, in the order of results."""
    if isinstance(camera, UnifiedCamera):
        plain = (camera.xi, *camera.focal, *camera.center, *camera.distortion)
        return dict(zip(OMNI_NAMES, plain, strict=True))
    values = {f"a{power}": value for power, value in enumerate(camera.polynomial)}
    values |= dict(zip(OCAM_NAMES, (*camera.center_row_column, *camera.affine[:2]), strict=True))
    values |= dict(zip(TANGENTIAL_NAMES, camera.tangential, strict=True))
    values |= dict(zip(ASTIGMATISM_NAMES, camera.astigmatism, strict=True))
    return values | dict(zip(WAVEFRONT_NAMES, camera.wavefront, strict=True))


def _unit(name: str, scale: float, *, is_omni: bool) -> float:
    """Return one step of a parameter, which moves the image by about a pixel; scale: half of its smaller side [px]."""
    if name in (*OMNI_NAMES[1:5], *OCAM_NAMES[:2]):
        return 1.0
    if is_omni or name in OCAM_NAMES[2:]:
        return 1 / scale
    if name in TANGENTIAL_NAMES:
        return float(1 / scale**2)
    if name in ASTIGMATISM_NAMES:
        return float(1 / scale**3)
    return WAVEFRONT_UNIT_M if name in WAVEFRONT_NAMES else float(scale ** -float(name[1:]))


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
