"""The rerun recording that all views draw on."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rerun", reason="needs the packages of omnid[view]")
from omnid.viewer.rerun_scene import Thinning


def test_thinning_keeps_few_messages_of_a_long_run() -> None:
    keep = Thinning(100)
    kept = [number for number in range(100_000) if keep()]
    assert kept[:100] == list(range(100)) and 100 * 9 < len(kept) < 100 * 12
    assert np.diff(kept).max() <= 2048


def test_thinning_is_even_with_a_known_number() -> None:
    keep = Thinning(100, expected=1050)
    kept = [number for number in range(1050) if keep()]
    assert kept == list(range(0, 1050, 11))
