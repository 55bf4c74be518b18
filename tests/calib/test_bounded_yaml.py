"""YAML of bounded size, plain data only."""

from __future__ import annotations

import pytest

from calib.bounded_yaml import parse_yaml
from calib.kalibr import export_kalibr, parse_kalibr
from calib.rig import Rig


def test_kalibr_files_are_far_below_the_limits(omni_rig: Rig) -> None:
    text = export_kalibr(omni_rig)
    several = "".join(text.replace("cam0", f"cam{2 * pair}").replace("cam1", f"cam{2 * pair + 1}") for pair in range(4))
    assert len(parse_yaml(several + "# a & b *c\nnote: 'a & *b'\n")) == 9
    assert parse_kalibr(text).baseline_m == pytest.approx(omni_rig.baseline_m)
