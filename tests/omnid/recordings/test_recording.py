"""The rule for which topic holds the poses: one table of cases, through all commands that read recorded runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.logs.mcap_writer import LogWriter
from omnid.cli import main
from omnid.transport import codec

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


def recording(path: Path, topics: tuple[str, ...]) -> Path:
    """Write three poses on each topic; those of the n-th topic are at x = n."""
    zero = np.zeros((6, 6))
    with LogWriter(path, {}) as log:
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


@pytest.mark.parametrize("case", CASES)
def test_the_report_has_the_topic_of_the_rule(tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    topics, topic, expected = CASES[case]
    log, page = recording(tmp_path / "log.mcap", topics), tmp_path / "report.html"
    code = main(["report", str(log), "-o", str(page), *(["--topic", topic] if topic else [])])
    if expected == REFUSED:
        assert code == 2 and "omnid: " in capsys.readouterr().err and not page.exists()
    else:
        assert code == 0 and f"3 poses of {expected}" in capsys.readouterr().out
