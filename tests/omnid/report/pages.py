"""Small recordings of an artificial run, and the tags of their pages, with what in them could do harm."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from calib import se3
from calib.rig import Rig
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_writer import LogWriter
from omnid.formats.tum import Trajectory
from omnid.report.charts import style_and_script
from omnid.report.recorded_run import RecordedRun
from omnid.report.report import report_html
from omnid.runs.session import attached_rig
from omnid.transport import codec
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, Key

SAMPLE = Path(__file__).parents[3] / "omnid" / "sample"


class Page(HTMLParser):
    """Tags with their attributes and text of a page; asserts that the tags match."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.scripts: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] == "script":
            self.scripts.append(data)
        else:
            self.text += data


def html_of(path: Path, truth: Trajectory | None = None) -> str:
    return report_html(RecordedRun(path), truth)


def assert_harmless(page: Page) -> None:
    """Assert that nothing in the page is executed or fetched."""
    names = {tag for tag, _ in page.tags}
    assert len(page.scripts) == 1 and page.scripts[0] == style_and_script()[1], "omnid's own, which the policy allows"
    assert not names & {"iframe", "object", "embed", "link", "base", "form", "foreignobject"}
    for tag, attributes in page.tags:
        assert not any(name.startswith("on") for name in attributes), (tag, attributes)
        for name in ("src", "href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/png;base64,", "data:image/jpeg;base64,"))


def attached_rig_of_sample() -> Rig:
    reader = LogReader(SAMPLE / "log.mcap")
    rig = attached_rig(reader, SAMPLE / "log.mcap")
    reader.close()
    return rig


START_NS = 1_700_000_000 * 10**9
PERIOD_NS = 100_000_000
Entry = tuple[int, str, str, bytes]  # stamp [ns], topic, type, message


def at(pose: float) -> int:
    """Return the stamp of a pose."""
    return START_NS + round(pose * PERIOD_NS)


def T_odom_base(pose: int) -> np.ndarray:
    """Return poses on a circle, 5 cm and 0.02 rad apart."""
    return se3.exp([2.5 * math.sin(0.02 * pose), 2.5 * (1 - math.cos(0.02 * pose)), 0, 0, 0, 0]) @ se3.exp(
        [0, 0, 0, 0, 0, 0.02 * pose]
    )


def odom(
    pose: int, T: np.ndarray | None = None, *, topic: str = "/omnid/odom", sigma_m: float = 0.01, speed_mps: float = 0.5
) -> Entry:
    """A pose."""
    covariance, velocity = np.eye(6) * sigma_m**2, np.array([speed_mps, 0, 0, 0, 0, 0.2])
    payload = codec.odometry_cdr(at(pose), T_odom_base(pose) if T is None else T, covariance, velocity, covariance)
    return at(pose), topic, codec.ODOMETRY_SCHEMA, payload


def map_pose(pose: int, T_map_odom: np.ndarray) -> Entry:
    """A pose in the map."""
    payload = codec.map_pose_cdr(at(pose), T_map_odom @ T_odom_base(pose), 1e-4 * np.eye(6))
    return at(pose), "/omnid/map_pose", codec.MAP_POSE_SCHEMA, payload


def status(pose: float, *statuses: DiagnosticStatus) -> Entry:
    """Return a status message at the time of a pose."""
    return at(pose), "/omnid/status", codec.DIAGNOSTICS_SCHEMA, codec.diagnostics_cdr(at(pose), statuses)


def state(pose: float, name: str, resets: int = 0) -> Entry:
    """Return the status of a new state, as the recorder writes it right after the first pose in it."""
    level = ("tracking", "degraded", "lost").index(name)
    values: dict[str, str] = {Key.STATE: name, Key.RESETS: str(resets), Key.INLIERS: "80", Key.TRACKED: "100"}
    return status(pose, DiagnosticStatus(ODOMETRY, level, name, values))


def drive(pose: float, speed_mps: float) -> Entry:
    """Return a command to the wheels."""
    payload = codec.twist_stamped_cdr(at(pose), "base_link", speed_mps, 0.1)
    return at(pose), "/omnid/drive", codec.TWIST_SCHEMA, payload


def cloud(pose: float, points: np.ndarray, frame: str = "odom") -> Entry:
    """Return a map."""
    payload = codec.point_cloud_cdr(at(pose), frame, points, np.ones(len(points)))
    return at(pose), "/omnid/cloud", codec.POINT_CLOUD_SCHEMA, payload


def save(path: Path, entries: Iterable[Entry], attachments: dict[str, bytes] | None = None) -> Path:
    """Write a log of these messages in their order and return its path."""
    with LogWriter(path, attachments) as log:
        for stamp_ns, topic, schema, payload in entries:
            log.write(topic, schema, payload, stamp_ns)
    return path


def corrupt_chunks(path: Path) -> None:
    """Change a byte in the second and the third chunk of a log; its index stays."""
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes  # type: ignore[union-attr]
    for chunk in chunks[1:3]:
        data[chunk.chunk_start_offset + chunk.chunk_length - 20] ^= 0xFF
    path.write_bytes(data)


def run(count: int = 100, lost: Sequence[int] = (), missing: Sequence[int] = ()) -> list[Entry]:
    """Return a run with tracked, lost and missing poses."""
    entries: list[Entry] = []
    before = ""
    for pose in (k for k in range(count) if k not in missing):
        entries.append(odom(pose, sigma_m=1.0 if pose in lost else 0.01))
        now = "lost" if pose in lost else "tracking"
        if now != before:
            entries.append(state(pose, now))
        before = now
    return entries
