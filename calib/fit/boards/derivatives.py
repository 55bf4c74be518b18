"""Derivatives of the pixels of ocam cameras by points and by named parameters: in closed form, but for wavefronts.

The names are those of models/names.py; d moves e along, because their difference is a rotation of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.fit.least_squares import BEST_STEP, central_differences
from calib.models.camera import Array
from calib.models.ocam import ASTIGMATISM_NAMES, TANGENTIAL_NAMES, OcamCamera
from calib.models.wavefront import WAVEFRONT_NAMES, directions_to


def pixel_derivatives(camera: OcamCamera, points: Array, names: Sequence[str]) -> tuple[Array, Array]:
    """Return the derivatives (N, 2, 3) by points (N, 3) [m], near ones as they are, and (N, 2, P) by the parameters.

    Not finite where the camera does not see a point. Scaramuzza et al. 2006, with the implicit function f(rho) r - z
    rho = 0 for the radius.
    """
    with np.errstate(all="ignore"):
        return _derivatives(camera, np.asarray(points, float), names)


def _derivatives(camera: OcamCamera, points: Array, names: Sequence[str]) -> tuple[Array, Array]:
    waves = [name for name in names if name in WAVEFRONT_NAMES]
    # 1. The direction of the ray through the point, of a mirror whose rays do not meet in one point.
    ray_by_point, rays = None, points
    ray_by_wave = dict[str, Array]()
    if waves or any(camera.wavefront):
        axis, wavefront = -camera.sign, np.array(camera.wavefront)
        rays = directions_to(points, camera.wavefront, axis)
        step = BEST_STEP * np.ones(len(wavefront))
        ray_by_point = central_differences(lambda by: directions_to(points + by, camera.wavefront, axis), step[:3])
        by_term = central_differences(lambda by: directions_to(points, tuple((wavefront + by).tolist()), axis), step)
        ray_by_wave = {name: by_term[..., WAVEFRONT_NAMES.index(name)] for name in waves}
    # 2. The radius of that direction.
    X, Y, z = rays[:, 0], rays[:, 1], camera.sign * rays[:, 2]
    r = np.hypot(X, Y)
    rho = camera.radius(r, z)
    f, slope = camera.height_and_slope(rho)
    by_rho = slope * r - z
    is_off_axis = r > 1e-12 * np.abs(z)
    safe = np.where(is_off_axis, r, 1.0)
    ux, uy = np.where(is_off_axis, X / safe, 0.0), np.where(is_off_axis, Y / safe, 0.0)
    ratio = np.where(is_off_axis, rho / safe, f / z)
    rho_by_r, rho_by_z = -f / by_rho, rho / by_rho
    # 3. The ideal point rho (X, Y) / r.
    x, y = X * ratio, Y * ratio
    cross = (rho_by_r - ratio) * ux * uy
    ideal_by_ray = np.stack(
        [
            _pairs(ratio + (rho_by_r - ratio) * ux * ux, cross),
            _pairs(cross, ratio + (rho_by_r - ratio) * uy * uy),
            _pairs(ux, uy) * (camera.sign * rho_by_z)[:, None],
        ],
        axis=2,
    )
    # 4. Tangential and astigmatic terms, and the affine.
    bent_x, bent_y = camera.distort(x, y)
    xx, xy, yy = camera.distortion_jacobian(x, y)
    c, d, e = camera.affine
    affine = np.array([[e, 1.0], [c, d]])
    A = affine @ np.stack([_pairs(xx, xy), _pairs(xy, yy)], axis=1)
    by_ray = A @ ideal_by_ray
    x2, y2, rho2, zero, one = x * x, y * y, x * x + y * y, np.zeros(len(x)), np.ones(len(x))
    columns = {
        "center_row": _pairs(zero, one),
        "center_column": _pairs(one, zero),
        "c": _pairs(zero, bent_x),
        "d": _pairs(bent_x, bent_y),
        TANGENTIAL_NAMES[0]: _pairs(2 * x * y, rho2 + 2 * y2) @ affine.T,
        TANGENTIAL_NAMES[1]: _pairs(rho2 + 2 * x2, 2 * x * y) @ affine.T,
        ASTIGMATISM_NAMES[0]: _pairs(4 * x2 * x, -4 * y2 * y) @ affine.T,
        ASTIGMATISM_NAMES[1]: _pairs(6 * x2 * y + 2 * y2 * y, 2 * x2 * x + 6 * x * y2) @ affine.T,
    }
    for name in names:
        if name[0] == "a":
            columns[name] = np.einsum("nij,nj->ni", A, _pairs(ux, uy) * (-r * rho ** int(name[1:]) / by_rho)[:, None])
    columns |= {name: np.einsum("nij,nj->ni", by_ray, change) for name, change in ray_by_wave.items()}
    by_point = by_ray if ray_by_point is None else by_ray @ ray_by_point
    by_name = [columns[name] for name in names]
    return by_point, np.stack(by_name, axis=2) if by_name else np.zeros((len(points), 2, 0))


def _pairs(u: Array, v: Array) -> Array:
    return np.stack([u, v], axis=1)
