"""The rig that is attached to a log, or the advice where there is none."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from calib.errors import CalibError
from calib.rig_file import rig_toml
from drivers.logs.log_reader import LogReader
from omnid.errors import OmnidError
from omnid.runs.session import attached_rig
from omnid.simulation.rendering.rigs import make_rig
from tests.drivers.logs.mcap_logs import pairs, write_log


def test_the_attached_rig_is_read(tmp_path: Path) -> None:
    rig = make_rig(size=256)
    log = write_log(tmp_path / "a.mcap", pairs(1), [("rig.toml", rig_toml(rig).encode())])
    with closing(LogReader(log)) as reader:
        assert attached_rig(reader, log).baseline_m == pytest.approx(rig.baseline_m)


@pytest.mark.parametrize(
    ("attached", "error", "words"),
    [([], OmnidError, "give one with --rig"), ([("rig.toml", b"x = ")], CalibError, "a.mcap: attached rig.toml: ")],
)
def test_a_log_without_a_rig_says_what_to_do(
    tmp_path: Path, attached: list[tuple[str, bytes]], error: type[Exception], words: str
) -> None:
    log = write_log(tmp_path / "a.mcap", pairs(1), attached)
    with closing(LogReader(log)) as reader, pytest.raises(error, match=words):
        attached_rig(reader, log)
