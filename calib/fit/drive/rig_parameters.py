"""Parameters of a bundle adjustment of a drive: both cameras, the transform between them, and times of exposure.

Each has a name, a value, a unit (one step of the fit), and a prior: the covariance of the rig's calibration, or the
tolerance of a nominal rig, whose numbers come from the mirror's data sheet, its rim in the images, and a ruler.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.fit.parameters import WAVEFRONT_UNIT_M, central_names, stepped, units_of
from calib.models.camera import Array, OmniCamera
from calib.models.names import is_coefficient, values_of
from calib.models.ocam import OcamCamera, wavefront_of
from calib.models.wavefront import WAVEFRONT_NAMES
from calib.rig import Rig, ShutterTimes
from calib.rig_covariance import TRANSFORM_NAMES as RIG_TRANSFORM_NAMES

ANGLE_UNIT_RAD: Final = 1.0 / 250.0  # one step of the transform between the cameras, because it is about a pixel
# The length of the baseline is no parameter: images of a drive do not determine the scale.
TRANSFORM_NAMES: Final = RIG_TRANSFORM_NAMES[:-1]
# Times of exposure, and one step of each, because some tenths of a pixel at walking speed.
UPPER_DELAY, LINE_TIME = "upper delay [ms]", "line time [us]"
TIME_UNITS: Final = {UPPER_DELAY: 5.0, LINE_TIME: 5.0}
S_PER_UNIT: Final = {UPPER_DELAY: 1e-3, LINE_TIME: 1e-6}
WAVE_NAMES: Final = tuple(f"{side} {name}" for side in ("lower", "upper") for name in WAVEFRONT_NAMES)
# Tolerances of a nominal rig, by the name of the parameter without its camera. Of focal lengths and polynomials: a part
# of their value, and pixels of what a polynomial has beyond a paraboloid's.
RELATIVE_SIGMA, HIGHER_SIGMA_PX = 0.02, 0.5
NOMINAL_SIGMAS: Final = {
    **dict.fromkeys(("r_x", "r_y", "r_z"), np.deg2rad(1.5)),
    **dict.fromkeys(("e_x", "e_y"), np.deg2rad(2.0)),
    **dict.fromkeys(("pu", "pv", "center_row", "center_column"), 3.0),
    # Cameras without a trigger, and lines of a rolling shutter.
    **{UPPER_DELAY: 15.0, LINE_TIME: 30.0, "xi": 0.02},
    # A ray of a mirror camera passes the viewpoint within about a millimetre.
    **dict.fromkeys(WAVEFRONT_NAMES, 1e-3),
}
# Tolerances of distortion terms, in steps, which move the image by about a pixel.
NOMINAL_STEPS: Final = {
    **dict.fromkeys(("p1", "p2"), 3.0),
    **dict.fromkeys(("k1", "k2", "c", "d", "s1", "s2"), 1.0),
}
RULER_SIGMA_M: Final = 0.5e-3
# Smallest part of a nominal sigma to which a board's covariance is trusted: mirrors are knocked and metal grows.
MIN_PART: Final = 1e-3


@dataclass(frozen=True, slots=True)
class RigParameters:
    """A rig as a function of steps (P,), the unknowns of the adjustment.

    Their order: parameters of the lower camera, of the upper camera, rotation (3) and direction of the baseline (2),
    wavefronts of both cameras (for mirrors whose rays do not meet in one point), times of exposure. The rig frame is
    fixed to the lower camera, because moving both would only move all poses.
    """

    rig: Rig
    lower: tuple[str, ...]  # names of the camera's parameters
    upper: tuple[str, ...]
    times: tuple[str, ...] = ()  # of TIME_UNITS
    waves: tuple[str, ...] = ()  # all of WAVE_NAMES, or none
    # The rig after the last turn (5,), which all steps of the cameras about one state share.
    _turned: dict[bytes, Rig] = field(default_factory=dict, init=False, repr=False, compare=False)

    @staticmethod
    def about(
        rig: Rig, distortion: Collection[str] = (), times: tuple[str, ...] = (), *, waves: bool = False
    ) -> RigParameters:
        """Return the parameters of a rig's camera models, with the rig's own values at steps of 0.

        distortion: names of the terms of omni cameras that are parameters even where the rig has 0 for them. times: of
        TIME_UNITS. waves: True if the wavefronts of both cameras are parameters.
        """
        lower, upper = (central_names(mounted.camera, distortion) for mounted in (rig.lower, rig.upper))
        return RigParameters(rig, lower, upper, times, WAVE_NAMES if waves else ())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the steps."""
        return (
            *(f"lower {name}" for name in self.lower),
            *(f"upper {name}" for name in self.upper),
            *TRANSFORM_NAMES,
            *self.waves,
            *self.times,
        )

    @property
    def rig_names(self) -> tuple[str, ...]:
        """Names of the steps of the rig, which come first."""
        return self.names[: len(self.names) - len(self.waves) - len(self.times)]

    @property
    def values(self) -> Array:
        """Values (P,) at steps of 0, in the parameters' own units; those of the transform are 0 rad."""
        known = dict.fromkeys(TRANSFORM_NAMES, 0.0)
        known |= dict(zip(WAVE_NAMES, self._waves().ravel().tolist(), strict=True))
        for side, mounted in (("lower", self.rig.lower), ("upper", self.rig.upper)):
            known |= {f"{side} {name}": value for name, value in values_of(mounted.camera).items()}
        known[UPPER_DELAY] = self.rig.times.upper_delay_s / S_PER_UNIT[UPPER_DELAY]
        known[LINE_TIME] = self.rig.times.line_time_s / S_PER_UNIT[LINE_TIME]
        return np.array([known[name] for name in self.names])

    @property
    def units(self) -> Array:
        """One step (P,) in the parameters' own units."""
        return np.concatenate(
            [
                units_of(self.rig.lower.camera, self.lower),
                units_of(self.rig.upper.camera, self.upper),
                np.full(len(TRANSFORM_NAMES), ANGLE_UNIT_RAD),
                np.full(len(self.waves), WAVEFRONT_UNIT_M),
                [TIME_UNITS[name] for name in self.times],
            ]
        )

    @property
    def nominal_sigmas(self) -> Array:
        """Standard deviations (P,) of the steps of a nominal rig."""
        sigmas = []
        for name, value, unit in zip(self.names, self.values.tolist(), self.units.tolist(), strict=True):
            own = name if name in TIME_UNITS else name.split()[-1]
            relative = RELATIVE_SIGMA * abs(value) / unit
            if own in NOMINAL_SIGMAS:
                sigmas.append(NOMINAL_SIGMAS[own] / unit)
            elif own in NOMINAL_STEPS:
                sigmas.append(NOMINAL_STEPS[own])
            else:
                higher = is_coefficient(own) and int(own[1:]) > 2
                sigmas.append(float(np.hypot(HIGHER_SIGMA_PX, relative)) if higher else relative)
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
        of_lower = np.array([name.startswith("lower ") for name in self.names])
        return np.asarray(~of_lower if camera else of_lower | (np.array(self.names) == LINE_TIME))

    def at(self, steps: Array) -> Rig:
        """Return the rig after steps (P,). Raise CalibError where they lead to parameters that no camera has."""
        first, second = len(self.lower), len(self.lower) + len(self.upper)
        turn = steps[second : second + len(TRANSFORM_NAMES)] * ANGLE_UNIT_RAD
        rig = self._turned.get(turn.tobytes())
        if rig is None:
            rig = self.rig.with_upper_moved(turn[:3], turn[3:])
            self._turned.clear()
            self._turned[turn.tobytes()] = rig
        lower, upper = (
            replace(mounted, camera=_with_wavefront(stepped(mounted.camera, names, part), wavefront))
            for mounted, names, part, wavefront in zip(
                (rig.lower, rig.upper),
                (self.lower, self.upper),
                (steps[:first], steps[first:second]),
                self.wavefronts_at(steps),
                strict=True,
            )
        )
        return replace(rig, lower=lower, upper=upper, covariance=None, times=self.times_at(steps))

    def transform_steps(self, rig: Rig) -> Array:
        """Return the steps (P,) that give this rig the transform between the cameras of another; all others are 0."""
        R_rect_rig = self.rig.T_rect_rig[:3, :3]
        R_rig_upper, own = rig.upper.T_cam_rig[:3, :3].T, self.rig.upper.T_cam_rig[:3, :3]
        turn = se3.rotation_log(R_rect_rig @ R_rig_upper @ own @ R_rect_rig.T)
        x, y, z = R_rect_rig @ (rig.upper.viewpoint - rig.lower.viewpoint)
        steps = np.zeros(len(self.names))
        first = len(self.rig_names) - len(TRANSFORM_NAMES)
        steps[first : len(self.rig_names)] = np.array([*turn, x / z, y / z]) / ANGLE_UNIT_RAD
        return steps

    def wavefronts_at(self, steps: Array) -> Array:
        """Return the wavefronts (2, 5) [m] of the lower and the upper camera after steps (P,)."""
        start = self._waves()
        if not self.waves:
            return start
        first = len(self.rig_names)
        return start + WAVEFRONT_UNIT_M * steps[first : first + len(self.waves)].reshape(start.shape)

    def _waves(self) -> Array:
        return np.array([wavefront_of(mounted.camera) for mounted in (self.rig.lower, self.rig.upper)])

    def times_at(self, steps: Array) -> ShutterTimes:
        """Return the times of exposure after steps (P,); a time that is no parameter stays that of the rig."""
        change = dict.fromkeys(TIME_UNITS, 0.0)
        for name, step in zip(self.times, steps[len(self.names) - len(self.times) :].tolist(), strict=True):
            change[name] = step * TIME_UNITS[name] * S_PER_UNIT[name]
        start = self.rig.times
        return ShutterTimes(start.upper_delay_s + change[UPPER_DELAY], start.line_time_s + change[LINE_TIME])

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


def _with_wavefront(camera: OmniCamera, wavefront: Array) -> OmniCamera:
    """Return the camera with a wavefront (5,) [m]; a camera whose model has none is returned as it is."""
    return replace(camera, wavefront=tuple(wavefront.tolist())) if isinstance(camera, OcamCamera) else camera
