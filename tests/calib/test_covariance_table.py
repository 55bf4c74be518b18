"""The table [covariance] of a rig.toml."""

from __future__ import annotations

import numpy as np
import pytest

from calib.covariance_table import covariance_text
from calib.errors import CalibError
from calib.rig import Rig
from calib.rig_covariance import RigCovariance
from calib.rig_file import parse_rig, rig_toml

SMALL = RigCovariance.of_matrix(("lower xi", "r_x", "baseline"), np.array([[4, 1, 0], [1, 9.0, 3], [0, 3, 16]]))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("version = 1", "version = 2", "covariance.version: expected 1, found 2"),
        ("version = 1", "version = true", "covariance.version"),
        ("version = 1", "version = 1\nmatrix = 3", "covariance.matrix: unknown key"),
        ('"r_x"', '"r_q"', "covariance.parameters: expected 1 to 160 names"),
        ('"lower xi"', '"lower a0"', "covariance.parameters"),
        ('"lower xi"', '"baseline"', "covariance: covariance: expected 1 to 160 different parameters"),
        ('"lower xi", ', "", "covariance.sigma: expected 2 finite numbers"),
        ('["lower xi", "r_x", "baseline"]', "[]", "covariance.parameters"),
        ("sigma = [2.0", "sigma = [-2.0", "expected sigmas of 0"),
        ("sigma = [2.0", "sigma = [1e200", "expected sigmas of 0"),
        ("sigma = [2.0", "sigma = [nan", "covariance.sigma: expected 3 finite numbers"),
        ("[0.0, 0.25]", "[0.0]", "covariance.correlation: expected 3 rows"),
        ("[0.0, 0.25]", "[0.0, 1.5]", "between -1 and 1"),
        ("[0.0, 0.25]", "[-0.99, 0.99]", "contradict each other"),
        ("[0.0, 0.25]", "[0.0, 'a']", "covariance.correlation: expected 2 finite numbers"),
        ("[0.0, 0.25]", "3", "covariance.correlation"),
    ],
)
def test_errors_name_the_key(omni_rig: Rig, old: str, new: str, message: str) -> None:
    text = rig_toml(omni_rig) + covariance_text(SMALL)
    assert text.count(old) >= 1 and parse_rig(text).covariance is not None
    at = text.index("[covariance]")
    with pytest.raises(CalibError) as caught:
        parse_rig(text[:at] + text[at:].replace(old, new, 1), name="my.toml")
    assert message in str(caught.value) and str(caught.value).startswith("my.toml: ") and "\n" not in str(caught.value)
