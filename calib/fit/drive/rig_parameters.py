"""Parameters of a bundle adjustment of a drive: both cameras, the transform between them, and times of exposure."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from calib import se3
from calib.fit.parameterisation import WAVEFRONT_UNIT_M, CameraParameterisation, parameterise
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import OcamCamera, wavefront_of
from calib.models.wavefront import WAVEFRONT_NAMES
from calib.rig import Rig, ShutterTimes
from calib.rig_covariance import TRANSFORM_NAMES as RIG_TRANSFORM_NAMES

ANGLE_UNIT_RAD = 1.0 / 250.0  # one step of the transform between the cameras, because it is about a pixel
# The length of the baseline is no parameter: images of a drive do not determine the scale.
TRANSFORM_NAMES = RIG_TRANSFORM_NAMES[:-1]
# Times of exposure, and one step of each, because some tenths of a pixel at walking speed.
UPPER_DELAY, LINE_TIME = "upper delay [ms]", "line time [us]"
TIME_UNITS = {UPPER_DELAY: 5.0, LINE_TIME: 5.0}
# exact, by the definition of the prefixes
S_PER_MS, S_PER_US = 1e-3, 1e-6
WAVE_NAMES = tuple(f"{side} {name}" for side in ("lower", "upper") for name in WAVEFRONT_NAMES)


def _with_wavefront(camera: OmniCamera, wavefront: Array) -> OmniCamera:
    """Return the camera with a wavefront (5,) [m]; a camera whose model has none is returned as it is."""
    return replace(camera, wavefront=tuple(wavefront.tolist())) if isinstance(camera, OcamCamera) else camera


@dataclass(frozen=True, slots=True)
class RigParameters:
    """A rig as a function of steps (P,), the unknowns of the adjustment.

    Their order: parameters of the lower camera, of the upper camera, rotation (3) and direction of the baseline (2),
    wavefronts of both cameras (for mirrors whose rays do not meet in one point), times of exposure. The rig frame is
    fixed to the lower camera, because moving both would only move all poses.
    """

    rig: Rig
    lower: CameraParameterisation
    upper: CameraParameterisation
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
        lower, upper = (parameterise(mounted.camera, distortion) for mounted in (rig.lower, rig.upper))
        return RigParameters(rig, lower, upper, times, WAVE_NAMES if waves else ())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the steps."""
        return (
            *(f"lower {name}" for name in self.lower.names),
            *(f"upper {name}" for name in self.upper.names),
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
        times = self.rig.times
        of_rig = {UPPER_DELAY: times.upper_delay_s / S_PER_MS, LINE_TIME: times.line_time_s / S_PER_US}
        return np.concatenate(
            [
                self.lower.start,
                self.upper.start,
                np.zeros(len(TRANSFORM_NAMES)),
                *([self.wavefronts_at(np.zeros(len(self.names))).ravel()] if self.waves else []),
                [of_rig[name] for name in self.times],
            ]
        )

    @property
    def units(self) -> Array:
        """One step (P,) in the parameters' own units."""
        return np.concatenate(
            [
                self.lower.units,
                self.upper.units,
                np.full(len(TRANSFORM_NAMES), ANGLE_UNIT_RAD),
                np.full(len(self.waves), WAVEFRONT_UNIT_M),
                [TIME_UNITS[name] for name in self.times],
            ]
        )

    def moves_camera(self, camera: int) -> Array:
        """Return flags (P,) of the steps that change the image of the lower (0) or the upper (1) camera."""
        of_lower = np.array([name.startswith("lower ") for name in self.names])
        return np.asarray(~of_lower if camera else of_lower | (np.array(self.names) == LINE_TIME))

    def at(self, steps: Array) -> Rig:
        """Return the rig after steps (P,). Raise CalibError where they lead to parameters that no camera has."""
        first, second = len(self.lower.names), len(self.lower.names) + len(self.upper.names)
        turn = steps[second : second + len(TRANSFORM_NAMES)] * ANGLE_UNIT_RAD
        rig = self._turned.get(turn.tobytes())
        if rig is None:
            rig = self.rig.with_upper_moved(turn[:3], turn[3:])
            self._turned.clear()
            self._turned[turn.tobytes()] = rig
        cameras = [
            _with_wavefront(own.camera_at(part), wavefront)
            for own, part, wavefront in zip(
                (self.lower, self.upper), (steps[:first], steps[first:second]), self.wavefronts_at(steps), strict=True
            )
        ]
        lower, upper = replace(rig.lower, camera=cameras[0]), replace(rig.upper, camera=cameras[1])
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
        start = np.array([wavefront_of(mounted.camera) for mounted in (self.rig.lower, self.rig.upper)])
        if not self.waves:
            return start
        first = len(self.rig_names)
        return start + WAVEFRONT_UNIT_M * steps[first : first + len(self.waves)].reshape(start.shape)

    def times_at(self, steps: Array) -> ShutterTimes:
        """Return the times of exposure after steps (P,); a time that is no parameter stays that of the rig."""
        values = dict(zip(self.times, steps[len(self.names) - len(self.times) :].tolist(), strict=True))
        start = self.rig.times
        return ShutterTimes(
            start.upper_delay_s + S_PER_MS * TIME_UNITS[UPPER_DELAY] * values.get(UPPER_DELAY, 0.0),
            start.line_time_s + S_PER_US * TIME_UNITS[LINE_TIME] * values.get(LINE_TIME, 0.0),
        )
