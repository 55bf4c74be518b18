"""`omnid report`: the page shows what is recorded and names what is missing, and text of the log is never executed."""

from __future__ import annotations

import base64
import hashlib
import math
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib import se3
from calib.rig import Rig
from calib.rig_file import rig_toml
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_writer import LogWriter
from omnid.cli import main
from omnid.formats.tum import Trajectory
from omnid.recordings.evaluation import evaluate
from omnid.report.page import style_and_script
from omnid.report.recorded_run import RecordedRun
from omnid.report.report import report_html
from omnid.runs.wiring import attached_rig
from omnid.transport import codec
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, PAIRING, PLACES, STAGE_PREFIX, WHEELS, Key

TERMINAL = "x\x1b[31m\x07\x9b2J"
EVIL = "<script>alert('x')</script>\"'&<img src=x onerror=y>"


def event_texts(found: RecordedRun) -> list[tuple[str, str]]:
    return [(event.source, event.text) for event in found.events()]


def test_command_writes_one_complete_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entries = [
        *run(100, lost=range(40, 50)),
        drive(3, 0.4),
        drive(60, 0.4),
        cloud(99, np.random.default_rng(1).uniform(-2, 3, (500, 3))),
    ]
    log, out = save(tmp_path / "log.mcap", entries), tmp_path / "out.html"
    assert main(["report", str(log), "-o", str(out)]) == 0
    assert "100 poses of /omnid/odom" in capsys.readouterr().out
    html = out.read_text("utf-8").replace("&#x27;", "'")
    page = Page(out.read_text("utf-8"))
    assert_harmless(page)
    for words in (
        "Run of omnid",
        "9.9 s",
        "4.95 m",
        "90.0 %",
        "sent to the wheels",
        "Standard deviation",
        "lost here",
        "of the map's 500 points",
    ):
        assert words in html, words
    images = [attributes["src"] or "" for tag, attributes in page.tags if tag == "img"]
    assert len(images) == 1 and images[0].startswith("data:image/png")  # the plan
    head = out.read_text("utf-8").partition("<title>")[0]
    digest = base64.b64encode(hashlib.sha256(page.scripts[0].encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{digest}'"
    assert f"http-equiv='Content-Security-Policy' content=\"{policy}\"" in head
    assert "The MIT License" in page.scripts[0], "of uPlot"


def test_a_hostile_log_is_shown_as_text(tmp_path: Path) -> None:
    stage = {"processed": EVIL, "dropped": EVIL, "work_p50_ms": EVIL}
    odometry = {"state": EVIL, "resets": EVIL, "inliers": EVIL, "capture_to_pose_p50_ms": EVIL}
    parts = (
        DiagnosticStatus(EVIL, 2, EVIL, {EVIL: EVIL, "drops": "1"}),
        DiagnosticStatus(f"{STAGE_PREFIX}{EVIL}", 1, EVIL, stage),
        DiagnosticStatus(TERMINAL, 1, TERMINAL, {}),
        DiagnosticStatus(ODOMETRY, 0, EVIL, odometry),
    )
    settings = f'robot = "{EVIL.replace(chr(34), "")}"\n["<b>"]\nx = 1\n'
    entries = [
        *(odom(k, topic=f"/{EVIL}/odom") for k in range(5)),
        (at(2), f"/{EVIL}/status", "diagnostic_msgs/msg/DiagnosticArray", status(2, *parts)[3]),
        (at(3), f"/{EVIL}/status", "diagnostic_msgs/msg/DiagnosticArray", status(3, *parts, *parts)[3]),
    ]
    log = save(
        tmp_path / "<b>log.mcap",
        entries,
        {"omnid.toml": settings.encode(), EVIL: b"", "rig.toml": b'schema = 1\n"<img src=x onerror=y>" = 1\n'},
    )
    html = html_of(log, Trajectory(np.array([at(k) for k in range(5)]), np.tile(np.eye(4), (5, 1, 1))))
    page = Page(html)
    assert_harmless(page)
    assert "<b>x" not in html and html.count("<script>") == 1 and "<b>log" not in html
    assert page.text.count(EVIL) > 5 and not set(html) & {"\x1b", "\x07", "\x9b"}


def test_states_gaps_resets_losses_and_messages_are_events(tmp_path: Path) -> None:
    camera = "omnid: upper camera"
    entries = [
        status(-20, DiagnosticStatus(ODOMETRY, 3, "no pose yet", {}), DiagnosticStatus(PAIRING, 1, "none", {})),
        *run(100, lost=range(80, 85), missing=range(30, 50)),
        state(95, "tracking", resets=1),
        status(
            61, DiagnosticStatus(camera, 0, "streaming", {"drops": "3"}), DiagnosticStatus(WHEELS, 0, "driving", {})
        ),
        status(
            71,
            DiagnosticStatus(camera, 2, "lost since 1.0 s", {"drops": "3"}),
            DiagnosticStatus(WHEELS, 1, "the pose is lost", {"stopped, the pose is lost": "1"}),
        ),
        status(
            81,
            DiagnosticStatus(camera, 2, "lost since 2.0 s", {"drops": "8"}),
            DiagnosticStatus(WHEELS, 0, "driving", {"stopped, the pose is lost": "1"}),
        ),
        state(4, "tracking"),  # recorded late
    ]
    found = RecordedRun(save(tmp_path / "log.mcap", entries))
    assert np.unique(found.ranks, return_counts=True)[1].tolist() == [75, 5]
    assert event_texts(found) == [
        ("pairing", "none"),
        ("poses", "none for 2.10 s"),
        ("upper camera", "lost since 1.0 s"),
        ("wheels", "the pose is lost"),
        ("wheels", "stopped, the pose is lost"),
        ("state", "lost"),
        ("upper camera", "images dropped"),
        ("wheels", "driving"),
        ("state", "tracking"),
        ("odometry", "odometry was reset, with an unknown gap"),
    ]
    text = Page(report_html(found)).text
    for words in ("images dropped (5)", "1resets", "lost here", "none for 2.10 s"):
        assert words in text, words


def test_invalid_messages_are_left_out_and_counted(tmp_path: Path) -> None:
    far = np.eye(4)
    far[0, 3] = 1e12
    entries = [*run(10), (at(10), *odom(10, far)[1:]), (at(11), *odom(5, np.eye(4))[1:]), odom(12)]
    found = RecordedRun(save(tmp_path / "log.mcap", entries))
    assert (len(found.t_s), found.left_out) == (11, 2)
    text = Page(report_html(found)).text
    assert "2 messages were left out" in text


def test_the_path_in_the_map_is_drawn_beside_that_of_odometry(tmp_path: Path) -> None:
    moved = se3.exp([0.3, 0.4, 0, 0, 0, 0.1])
    poses = [entry for k in range(60) for entry in (odom(k), map_pose(k, np.eye(4) if k < 30 else moved))]
    places = status(59, DiagnosticStatus(PLACES, 0, "localized", {"keyframes": "12", "loops": "3"}))
    found = RecordedRun(save(tmp_path / "a.mcap", [*poses, places]))
    assert len(found.map_xy) == 60 and 0.3 < np.linalg.norm(found.map_xy[-1] - found.xyz[-1, :2]) < 0.7
    text = Page(report_html(found)).text
    assert "in the map" in text and "keyframes 12" in text
    poses = [entry for k in range(60) for entry in (odom(k), map_pose(k, np.eye(4)))]
    for without in (run(), poses):
        assert "in the map" not in Page(html_of(save(tmp_path / "b.mcap", without))).text


def test_a_report_compares_with_the_truth_as_eval_does(tmp_path: Path) -> None:
    """The rig is displaced and rotated on its base, and the truth has another world frame."""
    rig = attached_rig_of_sample()
    T_base_rig, T_world_odom = se3.exp([0.3, -0.1, 0.5, 0.1, 0.2, 1.0]), se3.exp([5, -3, 1, 0, 0, 2.0])
    text = rig_toml(Rig(rig.lower, rig.upper, T_base_rig, rig.topics)).encode()
    log = save(tmp_path / "log.mcap", run(100), {"rig.toml": text})
    drift = [se3.exp([0.001 * k, 0, 0, 0, 0, 0.0005 * k]) for k in range(100)]
    T_odom_rig = np.array([se3.inverse(T_base_rig) @ T_odom_base(k) @ T_base_rig for k in range(100)])
    truth = Trajectory(np.array([at(k) for k in range(100)]), T_world_odom @ T_odom_rig @ np.array(drift))
    expected = evaluate(Trajectory(truth.stamps_ns, T_odom_rig), truth)
    text = Page(html_of(log, truth)).text
    assert "Against the truth" in text and f"{1e3 * expected.ate_rmse_m:.2f}" in text and "other axes" not in text


def test_scripts_close_their_brackets() -> None:
    for script in SAMPLE.parent.rglob("*.js"):
        text = script.read_text("utf-8")
        assert list(map(text.count, "([{")) == list(map(text.count, ")]}")), script


CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Any]:
    """The report of 10 s whose speed rises by 0.01 m/s each pose, in a browser, where no error occurs."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    entries = [odom(k, speed_mps=0.01 * k) for k in range(100)] + [drive(k, 0.4) for k in range(0, 100, 5)]
    (tmp_path / "run.html").write_text(html_of(save(tmp_path / "run.mcap", entries)), "utf-8")
    with playwright.sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        found = browser.new_page(viewport={"width": 390, "height": 844})
        errors: list[str] = []
        found.on("pageerror", lambda error: errors.append(str(error)))
        found.on("console", lambda message: errors.append(message.text))
        found.goto((tmp_path / "run.html").as_uri())
        yield found
        browser.close()
    assert errors == []


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_the_pointer_shows_values_and_the_place_on_the_plan(page: Any) -> None:
    charts = page.locator(".u-over")
    assert charts.count() > 4
    speed = page.locator("figure.chart", has_text="Forward speed")
    over = speed.locator(".u-over")
    over.scroll_into_view_if_needed()
    box = over.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    time_s, measured, _ = map(float, re.findall(r"-?[\d.]+", speed.locator(".u-legend").text_content()))
    assert 4 < time_s < 6 and measured == pytest.approx(0.1 * time_s, abs=0.011)
    assert page.locator(".sheet i").is_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= page.viewport_size["width"]


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
    payload = codec.encoded(
        codec.MAP_POSE_SCHEMA, (at(pose), "map"), (T_map_odom @ T_odom_base(pose), 1e-4 * np.eye(6).ravel())
    )
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
    with closing(LogWriter(path, attachments)) as log:
        for stamp_ns, topic, schema, payload in entries:
            log.write(topic, schema, payload, stamp_ns)
    return path


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
