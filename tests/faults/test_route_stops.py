"""Faults in the midst of a route: the wheels come to rest; `python -m tests.faults routes` measures the times."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.route_stops import stop_times, teach


@pytest.mark.slow
def test_the_wheels_rest_after_faults_in_the_midst_of_a_route(tmp_path: Path) -> None:
    site = tmp_path / "site"
    site.mkdir()
    teach(site)
    for number, cause in enumerate(
        ("no images at all", "the daemon killed (SIGKILL)", "the plug of the motor controller pulled")
    ):
        assert len(stop_times(site, tmp_path / f"{number}", cause, 1, seed=1)) == 1
