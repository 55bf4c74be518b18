"""A rig as a function of steps: cameras, the transform between them, times of exposure."""

from __future__ import annotations

import numpy as np
import pytest

from calib.fit.drive.rig_parameters import LINE_TIME, TRANSFORM_NAMES, UPPER_DELAY, RigParameters
from omnid.simulation.rendering.rigs import make_rig

RIG = make_rig(size=512, baseline_m=0.22, misaligned_deg=(0.6, -0.4, 0.5))


def steps_of(parameters: RigParameters, **values: float) -> np.ndarray:
    steps = np.zeros(len(parameters.names))
    for name, value in values.items():
        steps[parameters.names.index(name)] = value
    return steps


def test_no_steps_are_the_rig_itself() -> None:
    parameters = RigParameters.about(RIG)
    rig = parameters.at(np.zeros(len(parameters.names)))
    assert rig.lower.camera == RIG.lower.camera and np.allclose(rig.upper.T_cam_rig, RIG.upper.T_cam_rig)
    assert parameters.names == parameters.rig_names and len(parameters.values) == len(parameters.units)


def test_the_transform_of_another_rig_is_a_step() -> None:
    parameters = RigParameters.about(RIG)
    steps = np.zeros(len(parameters.names))
    steps[-len(TRANSFORM_NAMES) :] = [1.0, -2.0, 0.5, 0.7, -0.3]
    moved = parameters.at(steps)
    assert moved.baseline_m == pytest.approx(RIG.baseline_m), "images of a drive do not determine the scale"
    assert np.allclose(parameters.transform_steps(moved), steps, atol=0.02)


def test_times_of_exposure_are_steps_of_milliseconds_and_microseconds() -> None:
    parameters = RigParameters.about(RIG, times=(UPPER_DELAY, LINE_TIME))
    times = parameters.times_at(steps_of(parameters, **{UPPER_DELAY: 2.0, LINE_TIME: -1.0}))
    assert times.upper_delay_s == pytest.approx(RIG.times.upper_delay_s + 0.010)
    assert times.line_time_s == pytest.approx(RIG.times.line_time_s - 5e-6)


def test_steps_say_which_camera_they_move() -> None:
    parameters = RigParameters.about(RIG, times=(UPPER_DELAY, LINE_TIME))
    names = np.array(parameters.names)
    lower, upper = (set(names[parameters.moves_camera(camera)]) for camera in (0, 1))
    assert lower & upper == {LINE_TIME} and lower | upper == set(names) and UPPER_DELAY in upper
    assert set(TRANSFORM_NAMES) <= upper


def test_wavefronts_are_parameters_on_demand() -> None:
    parameters = RigParameters.about(RIG, waves=True)
    assert len(parameters.waves) == 10 and not parameters.wavefronts_at(np.zeros(len(parameters.names))).any()
    moved = parameters.wavefronts_at(np.ones(len(parameters.names)))
    assert moved.shape == (2, 5) and np.allclose(moved, moved[0, 0]) and moved[0, 0] > 0
