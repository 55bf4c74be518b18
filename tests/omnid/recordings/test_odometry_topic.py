"""The rule for which topic holds the poses: one table of cases, through all commands that read recorded runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.logs.mcap_info import read_log_info
from drivers.logs.mcap_writer import LogWriter
from omnid.cli import main
from omnid.errors import OmnidError
from omnid.recordings.odometry_topic import choose_odometry_topic
from omnid.recordings.run_series import read_run_series
from omnid.report.report_data import collect_report_data
from omnid.transport import codec
from tests.omnid.viewer.rrd import need_rerun, positions

START_NS = 1_700_000_000 * 10**9
REFUSED = ""
CASES = {  # name: (topics of the log, --topic, chosen topic or REFUSED)
    "one": (("/omnid/odom",), None, "/omnid/odom"),
    "one of any name": (("/wheels/odometry",), None, "/wheels/odometry"),
    "one without a robot": (("/odom",), None, "/odom"),
    "own name preferred": (("/odometry/filtered", "/omnid/odom"), None, "/omnid/odom"),
    "own name preferred to all others": (("/a/pose", "/omnid/odom", "/z/pose"), None, "/omnid/odom"),
    "several of other names": (("/a/pose", "/b/pose"), None, REFUSED),
    "several of the own name": (("/omnid/odom", "/rover/odom"), None, REFUSED),
    "named": (("/a/pose", "/b/pose"), "/b/pose", "/b/pose"),
    "named beside the own name": (("/omnid/odom", "/wheels/pose"), "/wheels/pose", "/wheels/pose"),
    "named but absent": (("/omnid/odom",), "/c", REFUSED),
    "none": ((), None, REFUSED),
}


def recording(path: Path, topics: tuple[str, ...], attached: bytes = b"") -> Path:
    """Write three poses on each topic; those of the n-th topic are at x = n."""
    zero = np.zeros((6, 6))
    with LogWriter(path, {"omnid.toml": attached}) as log:
        payload = codec.twist_stamped_cdr(START_NS, "base_link", 0.0, 0.0)
        log.write("/omnid/drive", codec.TWIST_SCHEMA, payload, START_NS)
        for number, topic in enumerate(topics):
            T = np.eye(4)
            T[0, 3] = number
            for index in range(3):
                stamp_ns = START_NS + index * 10**8
                payload = codec.odometry_cdr(stamp_ns, T, zero, np.zeros(6), zero)
                log.write(topic, codec.ODOMETRY_SCHEMA, payload, stamp_ns)
    return path


def chosen_by_rule(log: Path, topic: str | None, _: Path) -> str:
    return choose_odometry_topic(read_log_info(log), topic)


def chosen_by_diff(log: Path, topic: str | None, _: Path) -> str:
    return read_run_series(log, topic).topic


def chosen_by_report(log: Path, topic: str | None, _: Path) -> str:
    return collect_report_data(log, topic).topic


@pytest.mark.parametrize("chosen", [chosen_by_rule, chosen_by_diff, chosen_by_report])
@pytest.mark.parametrize("case", CASES)
def test_readers_choose_the_same_topic(
    tmp_path: Path, case: str, chosen: Callable[[Path, str | None, Path], str]
) -> None:
    topics, topic, expected = CASES[case]
    log = recording(tmp_path / "log.mcap", topics)
    if expected == REFUSED:
        with pytest.raises(OmnidError):
            chosen(log, topic, tmp_path)
    else:
        assert chosen(log, topic, tmp_path) == expected


@pytest.mark.parametrize("case", CASES)
def test_commands_choose_the_same_topic(tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    """`omnid diff` and `omnid report` print the topic; `omnid view` draws its poses, at x = the number of the topic."""
    need_rerun()
    topics, topic, expected = CASES[case]
    log, option = str(recording(tmp_path / "log.mcap", topics)), ["--topic", topic] if topic else []
    again = str(recording(tmp_path / "again.mcap", topics, b"a = 1\n"))  # not byte for byte the same
    code = 2 if expected == REFUSED else 0
    assert main(["diff", log, again, *option]) == code
    assert main(["report", log, "-o", str(tmp_path / "report.html"), *option]) == code
    assert main(["view", log, "-o", str(tmp_path / "out.rrd"), *option]) == code
    out, err = capsys.readouterr()
    if code:
        assert err.count("omnid: ") >= 3 and not (tmp_path / "report.html").exists()
    else:
        assert f"log.mcap, {expected}: 3 poses" in out and f"3 poses of {expected}" in out
        assert set(positions(tmp_path / "out.rrd")[1][:, 0]) == {float(topics.index(expected))}


def test_a_robot_stands_for_its_topic(tmp_path: Path) -> None:
    found = read_log_info(recording(tmp_path / "log.mcap", ("/rover/odom", "/site/digger/odom")))
    assert choose_odometry_topic(found, robot="rover") == "/rover/odom"
    assert choose_odometry_topic(found, robot="site/digger") == "/site/digger/odom"
    with pytest.raises(OmnidError, match="'/crane/odom'"):
        choose_odometry_topic(found, robot="crane")
