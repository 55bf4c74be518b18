"""A camera's parameters as small steps from those it has, each of about a pixel's effect: for joint adjustments."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera

OMNI_NAMES = ("xi", "fu", "fv", "pu", "pv", "k1", "k2", "p1", "p2")


@dataclass(frozen=True, slots=True)
class CameraParameters:
    """Steps (P,) about a camera: at() gives the camera, values its parameters there as its file has them."""

    base: OmniCamera
    names: tuple[str, ...]
    start: Array  # (P,) the base's parameters
    units: Array  # (P,) one step in the parameters' own units

    def at(self, steps: Array) -> OmniCamera:
        """The camera so many steps away; CalibError where there is none."""
        values = dict(zip(self.names, (self.start + steps * self.units).tolist(), strict=True))
        return _omni(self.base, values) if isinstance(self.base, UnifiedCamera) else _ocam(self.base, values)

    def values(self, steps: Array, sigmas: Array) -> list[tuple[str, float, float]]:
        """Name, value and standard deviation of every parameter, of steps with deviations (P,)."""
        found = zip(self.names, self.start + steps * self.units, sigmas * self.units, strict=True)
        return [(name, float(value), float(sigma)) for name, value, sigma in found]


def nudge(camera: OmniCamera) -> CameraParameters:
    """The steps about a camera: all its parameters, but of the distortion and polynomial only the terms it has."""
    scale = min(camera.size) / 2
    if isinstance(camera, UnifiedCamera):
        values = np.array([camera.xi, *camera.focal, *camera.center, *camera.distortion])
        kept = np.array([True] * 5 + [value != 0 for value in camera.distortion])
        units = np.array([1, scale, scale, scale, scale, 1, 1, 1, 1]) / scale
        return CameraParameters(camera, tuple(np.array(OMNI_NAMES)[kept].tolist()), values[kept], units[kept])
    if not isinstance(camera, OcamCamera):
        raise CalibError(f"calibrate: expected an omni or ocam camera, found {type(camera).__name__}")
    powers = [power for power, value in enumerate(camera.polynomial) if value != 0]
    start = np.array([*(camera.polynomial[power] for power in powers), *camera.center_row_column, *camera.affine[:2]])
    units = np.array([*(scale ** -float(power) for power in powers), 1.0, 1.0, 1 / scale, 1 / scale])
    return CameraParameters(
        camera, (*(f"a{power}" for power in powers), "center_row", "center_column", "c", "d"), start, units
    )


def _omni(base: UnifiedCamera, values: dict[str, float]) -> UnifiedCamera:
    xi, fu, fv, pu, pv = (values[name] for name in OMNI_NAMES[:5])
    k1, k2, p1, p2 = (values.get(name, 0.0) for name in OMNI_NAMES[5:])
    return replace(base, xi=xi, focal=(fu, fv), center=(pu, pv), distortion=(k1, k2, p1, p2))


def _ocam(base: OmniCamera, values: dict[str, float]) -> OcamCamera:
    """d and e move together: the rest of them is a turn of the image, which a turn of the camera is as well."""
    assert isinstance(base, OcamCamera)
    polynomial = tuple(values.get(f"a{power}", 0.0) for power in range(len(base.polynomial)))
    affine = (values["c"], values["d"], base.affine[2] + values["d"] - base.affine[1])
    return replace(base, polynomial=polynomial, center_row_column=(values["center_row"], values["center_column"]),
                   affine=affine)
