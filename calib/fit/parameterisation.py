"""Camera parameterisation: scaled steps about a camera's parameters, one unit moving the image by about a pixel."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera

OMNI_NAMES = ("xi", "fu", "fv", "pu", "pv", "k1", "k2", "p1", "p2")
OCAM_TANGENTIAL_NAMES, OCAM_ASTIGMATISM_NAMES = ("p1", "p2"), ("s1", "s2")
WAVEFRONT_NAMES = ("w_a", "w_b", "w_x", "w_y", "w_s")
# One step of a wavefront's coefficient [m]: about half a pixel of a board at half a metre, as of the other parameters.
WAVEFRONT_UNIT_M = 1e-3


@dataclass(frozen=True, slots=True)
class CameraParameterisation:
    """Local parameterisation of a camera by steps (P,): camera_at() makes a camera, values() lists its parameters."""

    base: OmniCamera
    names: tuple[str, ...]
    start: Array  # (P,) the base's parameters
    units: Array  # (P,) one step in the parameters' own units

    def camera_at(self, steps: Array) -> OmniCamera:
        """Return the camera at the steps; raises CalibError if its parameters are not those of a camera."""
        values = dict(zip(self.names, (self.start + steps * self.units).tolist(), strict=True))
        if isinstance(self.base, UnifiedCamera):
            return _omni_camera(self.base, values)
        return _ocam_camera(self.base, values)

    def values(self, steps: Array, sigmas: Array) -> list[tuple[str, float, float]]:
        """Return name, value and standard deviation of every parameter, for steps (P,) and their sigmas (P,)."""
        found = zip(self.names, self.start + steps * self.units, sigmas * self.units, strict=True)
        return [(name, float(value), float(sigma)) for name, value, sigma in found]


def parameterise(
    camera: OmniCamera, distortion: Collection[str] = (), *, wavefront: bool = False
) -> CameraParameterisation:
    """Return the parameterisation about a camera: all parameters, and of distortion and polynomial the terms not 0.

    distortion: names of an omni camera's terms that are parameters although they are 0. wavefront: with the terms of an
    ocam camera's wavefront, and its secondary astigmatism, even if they are 0. Without, the wavefront stays: only near
    objects such as boards show it.
    """
    scale = min(camera.size) / 2
    if isinstance(camera, UnifiedCamera):
        values = np.array([camera.xi, *camera.focal, *camera.center, *camera.distortion])
        kept = (values != 0) | np.isin(OMNI_NAMES, [*OMNI_NAMES[:5], *distortion])
        units = np.array([1, scale, scale, scale, scale, 1, 1, 1, 1]) / scale
        return CameraParameterisation(camera, tuple(np.array(OMNI_NAMES)[kept].tolist()), values[kept], units[kept])
    if not isinstance(camera, OcamCamera):
        raise CalibError(
            f"calibrate: expected an omni or ocam camera, whose parameters can be fitted, found "
            f"{type(camera).__name__}: calibrate lenses by Kalibr"
        )
    powers = [power for power, value in enumerate(camera.polynomial) if value != 0]
    # p1 and p2 are correlated, so both are adjusted or neither.
    tangential = camera.tangential if any(camera.tangential) else ()
    astigmatism = camera.astigmatism if wavefront or any(camera.astigmatism) else ()
    waves = camera.wavefront if wavefront else ()
    start = np.array(
        [
            *(camera.polynomial[power] for power in powers),
            *camera.center_row_column,
            *camera.affine[:2],
            *tangential,
            *astigmatism,
            *waves,
        ]
    )
    units = np.array(
        [
            *(scale ** -float(power) for power in powers),
            1.0,
            1.0,
            1 / scale,
            1 / scale,
            *[1 / scale**2 for _ in tangential],
            *[1 / scale**3 for _ in astigmatism],
            *[WAVEFRONT_UNIT_M for _ in waves],
        ]
    )
    names = (
        *(f"a{power}" for power in powers),
        "center_row",
        "center_column",
        "c",
        "d",
        *OCAM_TANGENTIAL_NAMES[: len(tangential)],
        *OCAM_ASTIGMATISM_NAMES[: len(astigmatism)],
        *WAVEFRONT_NAMES[: len(waves)],
    )
    return CameraParameterisation(camera, names, start, units)


def _omni_camera(base: UnifiedCamera, values: dict[str, float]) -> UnifiedCamera:
    xi, fu, fv, pu, pv = (values[name] for name in OMNI_NAMES[:5])
    k1, k2, p1, p2 = (values.get(name, 0.0) for name in OMNI_NAMES[5:])
    return replace(base, xi=xi, focal=(fu, fv), center=(pu, pv), distortion=(k1, k2, p1, p2))


def _ocam_camera(base: OmniCamera, values: dict[str, float]) -> OcamCamera:
    """Return the camera of named values. d and e move together: their difference equals a rotation of the camera."""
    assert isinstance(base, OcamCamera)
    polynomial = tuple(values.get(f"a{power}", 0.0) for power in range(len(base.polynomial)))
    affine = (values["c"], values["d"], base.affine[2] + values["d"] - base.affine[1])
    p1, p2 = (values.get(name, 0.0) for name in OCAM_TANGENTIAL_NAMES)
    s1, s2 = (values.get(name, 0.0) for name in OCAM_ASTIGMATISM_NAMES)
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
