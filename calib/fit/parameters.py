"""Parameters of cameras and rigs in fits: names, units, and what is known of them before a fit.

One step of a parameter moves the image by about a pixel. Its prior is the covariance of the rig's calibration, or the
tolerance of a nominal rig, whose numbers come from the mirror's data sheet, its rim in the images, and a ruler.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib import se3
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
TRANSFORM_NAMES: Final = RIG_TRANSFORM_NAMES[:-1]
ANGLE_UNIT_RAD: Final = 1.0 / 250.0
# Times of exposure; a step is one of their units.
UPPER_DELAY, LINE_TIME = "upper delay [ms]", "line time [us]"
TIMES: Final = (UPPER_DELAY, LINE_TIME)
S_PER_UNIT: Final = {UPPER_DELAY: 1e-3, LINE_TIME: 1e-6}
# Tolerances of a nominal rig in the parameters' own units, by the name without its camera: those of mount and trigger,
# and of a mirror whose rays pass the viewpoint within about a millimetre.
NOMINAL_SIGMAS: Final[dict[str, float]] = {
    **dict.fromkeys(("r_x", "r_y", "r_z"), math.radians(1.5)),
    **dict.fromkeys(("e_x", "e_y"), math.radians(2.0)),
    **dict.fromkeys(("pu", "pv", "center_row", "center_column"), 3.0),
    **{UPPER_DELAY: 15.0, LINE_TIME: 30.0, "xi": 0.02},
    **dict.fromkeys(WAVEFRONT_NAMES, 1e-3),
}
# Tolerances of distortion terms, in steps.
NOMINAL_STEPS: Final = {
    **dict.fromkeys(("p1", "p2"), 3.0),
    **dict.fromkeys(("k1", "k2", "c", "d", "s1", "s2"), 1.0),
}
# Tolerance of focal lengths and polynomials as a fraction of their value, and of terms beyond a paraboloid's in steps.
RELATIVE_SIGMA, HIGHER_STEPS = 0.02, 0.5
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

        distortion: names of the terms of omni cameras that are parameters even where the rig has 0 for them. times: of
        TIME_UNITS. waves: True if the wavefronts of ocam cameras are parameters.
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
    def of_transform(self) -> slice:
        """The steps of the transform between the cameras."""
        return slice(len(self.rig_names) - len(TRANSFORM_NAMES), len(self.rig_names))

    @property
    def values(self) -> Array:
        """Values (P,) at steps of 0, in the parameters' own units; those of the transform are 0 rad."""
        times = self.rig.times
        known = {UPPER_DELAY: times.upper_delay_s / S_PER_UNIT[UPPER_DELAY]}
        known[LINE_TIME] = times.line_time_s / S_PER_UNIT[LINE_TIME]
        for side, mounted in self.rig.sides:
            known |= {f"{side} {name}": value for name, value in values_of(mounted.camera).items()}
        return np.array([known.get(name, 0.0) for name in self.names])

    @property
    def units(self) -> Array:
        """One step (P,) in the parameters' own units."""
        known = dict.fromkeys(TRANSFORM_NAMES, ANGLE_UNIT_RAD) | dict.fromkeys(TIMES, 1.0)
        for side, mounted in self.rig.sides:
            own = [name.partition(" ")[2] for name in self.names if name.startswith(f"{side} ")]
            units = units_of(mounted.camera, own).tolist()
            known |= {f"{side} {name}": unit for name, unit in zip(own, units, strict=True)}
        return np.array([known[name] for name in self.names])

    @property
    def nominal_sigmas(self) -> Array:
        """Standard deviations (P,) of the steps of a nominal rig."""
        sigmas = []
        for name, value, unit in zip(self.names, self.values.tolist(), self.units.tolist(), strict=True):
            own = name if name in TIMES else name.split()[-1]
            relative = RELATIVE_SIGMA * abs(value) / unit
            is_higher = is_coefficient(own) and int(own[1:]) > 2
            steps = NOMINAL_STEPS.get(own, np.hypot(HIGHER_STEPS, relative) if is_higher else relative)
            sigmas.append(NOMINAL_SIGMAS[own] / unit if own in NOMINAL_SIGMAS else steps)
        return np.array(sigmas)

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

    def moves_camera(self, camera: int) -> Array:
        """Return flags (P,) of the steps that change the image of the lower (0) or the upper (1) camera."""
        return np.array([name == LINE_TIME or name.startswith("lower ") == (camera == 0) for name in self.names])

    def at(self, steps: Array) -> Rig:
        """Return the rig after steps (P,). Raise CalibError where they lead to parameters that no camera has."""
        changes = dict(zip(self.names, (steps * self.units).tolist(), strict=True))
        changes = {name: change for name, change in changes.items() if name not in self.times}
        return replace(moved_rig(self.rig, changes), covariance=None, times=self.times_at(steps))

    def times_at(self, steps: Array) -> ShutterTimes:
        """Return the times of exposure after steps (P,); a time that is no parameter stays that of the rig."""
        own = dict(zip(self.times, steps[len(self.names) - len(self.times) :].tolist(), strict=True))
        upper_s, line_s = (own.get(name, 0.0) * S_PER_UNIT[name] for name in TIMES)
        return ShutterTimes(self.rig.times.upper_delay_s + upper_s, self.rig.times.line_time_s + line_s)

    def transform_steps(self, rig: Rig) -> Array:
        """Return the steps (P,) that give this rig the transform between the cameras of another; all others are 0."""
        R_rect_rig = se3.R_of(self.rig.T_rect_rig)
        R_rig_upper, own = se3.R_of(rig.upper.T_cam_rig).T, se3.R_of(self.rig.upper.T_cam_rig)
        turn = se3.rotation_log(R_rect_rig @ R_rig_upper @ own @ R_rect_rig.T)
        x, y, z = R_rect_rig @ (rig.upper.viewpoint - rig.lower.viewpoint)
        steps = np.zeros(len(self.names))
        steps[self.of_transform] = np.array([*turn, x / z, y / z]) / ANGLE_UNIT_RAD
        return steps

    def baseline(self, change: Array, covariance: Array) -> tuple[float, Array]:
        """Return the length of the baseline [m] and the covariance (Q + 1, Q + 1) of the rig's parameters and it.

        Images do not show the length. Where the rig's covariance relates it to other parameters, their change (Q,) and
        covariance (Q, Q), in their own units, move it: the conditional of a normal distribution.
        """
        names, known = self.rig_names, self.rig.covariance
        gain, variance = np.zeros(len(names)), RULER_SIGMA_M**2
        if known is not None and "baseline" in known.names:
            chosen = [k for k, name in enumerate(names) if name in known.names]
            prior = known.select([*(names[k] for k in chosen), "baseline"]).matrix
            scale = np.sqrt(np.maximum(np.diag(prior)[:-1], np.finfo(float).tiny))
            try:
                gain[chosen] = np.linalg.solve(prior[:-1, :-1] / np.outer(scale, scale), prior[:-1, -1] / scale) / scale
            except np.linalg.LinAlgError:
                raise CalibError("calibrate drive: the covariance of the rig's file is singular") from None
            variance = max(0.0, float(prior[-1, -1] - gain[chosen] @ prior[:-1, -1]))
        J = np.vstack([np.eye(len(names)), gain])
        matrix = J @ covariance @ J.T
        matrix[-1, -1] += variance
        return self.rig.baseline_m + float(gain @ change), np.asarray(matrix)
