"""Parameters of cameras and rigs in fits: names, units, and what is known of them before a fit.

One step of a parameter moves the image by about a pixel. Its prior is the covariance of the rig's calibration, or the
tolerance of a nominal rig.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.names import changed, is_coefficient, values_of
from calib.models.ocam import ASTIGMATISM_NAMES, TANGENTIAL_NAMES, OcamCamera
from calib.models.unified import DISTORTION_NAMES, UnifiedCamera
from calib.models.wavefront import WAVEFRONT_NAMES
from calib.rig import TRANSFORM_NAMES as RIG_TRANSFORM_NAMES
from calib.rig import Rig, ShutterTimes

# One step of a wavefront's coefficient [m] moves a board at half a metre by about half a pixel.
WAVEFRONT_UNIT_M: Final = 1e-3
# The length of the baseline is no parameter of a drive, whose images do not determine the scale.
TRANSFORM_NAMES: Final = tuple(name for name in RIG_TRANSFORM_NAMES if name != "baseline")
# One step of an angle; of a time it is what passes during that turn at 1 rad/s.
ANGLE_UNIT_RAD: Final = 1.0 / 250.0
TIMES: Final = ("upper delay [s]", "line time [s]")
UPPER_DELAY, LINE_TIME = TIMES
# Tolerances of a nominal rig in steps, which are about pixels: of what a data sheet, the rim in the images and a ruler
# state, and of the terms of a shape that is not quite the model's.
STATED_STEPS, SHAPE_STEPS = 5.0, 1.0
SHAPE_NAMES: Final = ("k1", "k2", "c", "d", *ASTIGMATISM_NAMES, *WAVEFRONT_NAMES)
RULER_SIGMA_M: Final = 0.5e-3
# Least sigma of a calibrated parameter, as a fraction of the nominal one: mirrors are knocked and metal grows.
MIN_PART: Final = 1e-3


def central_names(camera: OmniCamera, distortion: Collection[str] = ()) -> tuple[str, ...]:
    """Return the parameters of a camera without its wavefront; of distortion and polynomial those that are not 0.

    distortion: terms of an omni camera that are parameters although they are 0. CalibError for other models.
    """
    values = values_of(camera)
    if isinstance(camera, UnifiedCamera):
        return tuple(name for name in values if name not in DISTORTION_NAMES or name in distortion or values[name] != 0)
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
    units = dict.fromkeys(("fu", "fv", "pu", "pv", "center_row", "center_column"), 1.0)
    units |= dict.fromkeys(WAVEFRONT_NAMES, WAVEFRONT_UNIT_M)
    if isinstance(camera, OcamCamera):
        units |= dict.fromkeys(TANGENTIAL_NAMES, scale**-2) | dict.fromkeys(ASTIGMATISM_NAMES, scale**-3)
        units |= {name: scale ** -float(name[1:]) for name in names if is_coefficient(name)}
    return np.array([units.get(name, 1 / scale) for name in names])


def stepped(camera: OmniCamera, names: Sequence[str], steps: Array) -> OmniCamera:
    """Return the camera after steps (P,) of its named parameters; CalibError where that is no camera."""
    return changed(camera, dict(zip(names, (steps * units_of(camera, names)).tolist(), strict=True)))


def moved_rig(rig: Rig, changes: Mapping[str, float]) -> Rig:
    """Return the rig after changes of named parameters, in their own units; names as in RigCovariance.

    Raises CalibError if the result is no camera.
    """
    r_x, r_y, r_z, e_x, e_y, longer = (changes.get(name, 0.0) for name in RIG_TRANSFORM_NAMES)
    moved = rig.with_upper_moved(np.array([r_x, r_y, r_z]), np.array([e_x, e_y]), longer)
    lower, upper = (
        replace(
            mounted,
            camera=changed(
                mounted.camera,
                {own: change for name, change in changes.items() for of, _, own in [name.partition(" ")] if of == side},
            ),
        )
        for side, mounted in moved.sides
    )
    return replace(moved, lower=lower, upper=upper)


@dataclass(frozen=True, slots=True)
class RigParameters:
    """A rig as a function of steps (P,) of named parameters, the common unknowns of the adjustment of a drive.

    Their order: parameters of the lower camera, of the upper camera, rotation (3) and direction of the baseline (2),
    wavefronts of both cameras (for mirrors whose rays do not meet in one point), times of exposure. The rig frame is
    fixed to the lower camera, because moving both would only move all poses.
    """

    rig: Rig
    rig_names: tuple[str, ...]  # without wavefronts and times
    waves: tuple[str, ...] = ()
    times: tuple[str, ...] = ()  # of TIMES

    @staticmethod
    def about(
        rig: Rig, distortion: Collection[str] = (), times: tuple[str, ...] = (), *, waves: bool = False
    ) -> RigParameters:
        """Return the parameters of a rig's camera models, with the rig's own values at steps of 0.

        distortion: names of the terms of omni cameras that are parameters even where the rig has 0 for them. times:
        of TIMES. waves: True if the wavefronts of ocam cameras are parameters.
        """
        cameras = (("lower", rig.lower.camera), ("upper", rig.upper.camera))
        own = [f"{side} {name}" for side, camera in cameras for name in central_names(camera, distortion)]
        having_waves = [side for side, camera in cameras if waves and isinstance(camera, OcamCamera)]
        wave_names = tuple(f"{side} {name}" for side in having_waves for name in WAVEFRONT_NAMES)
        return RigParameters(rig, (*own, *TRANSFORM_NAMES), wave_names, times)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the steps."""
        return (*self.rig_names, *self.waves, *self.times)

    @property
    def values(self) -> Array:
        """Values (P,) at steps of 0, in the parameters' own units; those of the transform are 0 rad."""
        known = {UPPER_DELAY: self.rig.times.upper_delay_s, LINE_TIME: self.rig.times.line_time_s}
        for side, mounted in self.rig.sides:
            known |= {f"{side} {name}": value for name, value in values_of(mounted.camera).items()}
        return np.array([known.get(name, 0.0) for name in self.names])

    @property
    def units(self) -> Array:
        """One step (P,) in the parameters' own units."""
        known = dict.fromkeys((*TRANSFORM_NAMES, UPPER_DELAY), ANGLE_UNIT_RAD)
        known[LINE_TIME] = ANGLE_UNIT_RAD / self.rig.lower.camera.size[1]
        for side, mounted in self.rig.sides:
            own = [name.partition(" ")[2] for name in self.names if name.startswith(f"{side} ")]
            units = units_of(mounted.camera, own).tolist()
            known |= {f"{side} {name}": unit for name, unit in zip(own, units, strict=True)}
        return np.array([known[name] for name in self.names])

    @property
    def nominal_sigmas(self) -> Array:
        """Standard deviations (P,) of the steps of a nominal rig."""
        own = [name.split()[-1] for name in self.names]
        is_shape = [name in SHAPE_NAMES or (is_coefficient(name) and int(name[1:]) > 2) for name in own]
        return np.where(is_shape, SHAPE_STEPS, STATED_STEPS)

    def prior(self) -> Array:
        """Return the information (P, P) of the steps about zero, by the rig's covariance as far as it has one."""
        covariance = self.rig.covariance
        matrix = np.diag(self.nominal_sigmas**2)
        known = [k for k, name in enumerate(self.names) if covariance is not None and name in covariance.names]
        if covariance is not None and known:
            units = self.units[known]
            of_boards = covariance.select([self.names[k] for k in known]).matrix / np.outer(units, units)
            matrix[np.ix_(known, known)] = of_boards + MIN_PART**2 * matrix[np.ix_(known, known)]
        return np.asarray(np.linalg.inv(matrix))

    def at(self, steps: Array) -> Rig:
        """Return the rig after steps (P,). Raise CalibError where they lead to parameters that no camera has."""
        changes = dict(zip(self.names, (steps * self.units).tolist(), strict=True))
        changes = {name: change for name, change in changes.items() if name not in self.times}
        return replace(moved_rig(self.rig, changes), covariance=None, times=self.times_at(steps))

    def times_at(self, steps: Array) -> ShutterTimes:
        """Return the times of exposure after steps (P,); a time that is no parameter stays that of the rig."""
        own = dict(zip(self.names, (steps * self.units).tolist(), strict=True))
        times = self.rig.times
        return ShutterTimes(
            times.upper_delay_s + own.get(UPPER_DELAY, 0.0), times.line_time_s + own.get(LINE_TIME, 0.0)
        )

    def turned(self, turn: Array) -> Array:
        """Return the steps (P,) that rotate the upper camera by a vector (3,) [rad]; all others are 0."""
        known = dict(zip(TRANSFORM_NAMES, (turn / ANGLE_UNIT_RAD).tolist(), strict=False))
        return np.array([known.get(name, 0.0) for name in self.names])

    def baseline(self, change: Array, covariance: Array) -> tuple[float, Array]:
        """Return the length of the baseline [m] and the covariance (Q + 1, Q + 1) of the rig's parameters and it.

        Images do not show the length. Where the rig's covariance relates it to other parameters, their change (Q,) and
        covariance (Q, Q), in their own units, move it: the conditional of a normal distribution.
        """
        names, known = self.rig_names, self.rig.covariance
        gain, variance = np.zeros(len(names)), RULER_SIGMA_M**2
        if known is not None and "baseline" in known.names:
            chosen = [k for k, name in enumerate(names) if name in known.names]
            prior = known.select([*(names[k] for k in chosen), "baseline"])
            share = np.linalg.pinv(prior.correlation[:-1, :-1], hermitian=True) @ prior.correlation[:-1, -1]
            gain[chosen] = share * prior.sigmas[-1] / np.maximum(prior.sigmas[:-1], np.finfo(float).tiny)
            variance = prior.sigmas[-1] ** 2 * max(0.0, 1 - float(share @ prior.correlation[:-1, -1]))
        J = np.vstack([np.eye(len(names)), gain])
        matrix = J @ covariance @ J.T
        matrix[-1, -1] += variance
        return self.rig.baseline_m + float(gain @ change), np.asarray(matrix)
