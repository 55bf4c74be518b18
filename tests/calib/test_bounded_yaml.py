"""YAML of bounded size, plain data only."""

from __future__ import annotations

from calib.bounded_yaml import parse_yaml
from tests.calib.test_kalibr import BOTH, NAMED, T_UPPER_LOWER, chain


def test_kalibr_files_are_far_below_the_limits() -> None:
    text = chain(BOTH, T_UPPER_LOWER, NAMED)
    several = "".join(text.replace("cam0", f"cam{2 * pair}").replace("cam1", f"cam{2 * pair + 1}") for pair in range(4))
    assert len(parse_yaml(several + "# a & b *c\nnote: 'a & *b'\n")) == 9
