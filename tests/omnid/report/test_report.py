"""`omnid report`: the page shows what is recorded and names what is missing, and text of the log is never executed."""

from __future__ import annotations

import base64
import hashlib
import random
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from calib import se3
from calib.rig import Rig
from calib.rig_file import rig_toml
from drivers.logs.log_reader import LogReader
from omnid.cli import main
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory, read_tum, tum_row
from omnid.recordings.evaluation import evaluate
from omnid.report.page_script import chart_script
from omnid.report.report import report_html
from omnid.report.report_data import ReportData, collect_report_data
from omnid.report.truth_comparison import compare_with_truth
from omnid.runs.log_rig import attached_rig
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, PLACES, SUMMARY, WHEELS, camera_name, stage_name
from tests.omnid.report.recorded_logs import (
    T_odom_base,
    at,
    cloud,
    drive,
    map_pose,
    odom,
    run,
    save,
    state,
    status,
)

TERMINAL = "x\x1b[31m\x07\x9b2J"
SAMPLE = Path(__file__).parents[3] / "omnid" / "sample"
EVIL = "<script>alert('x')</script>\"'&<img src=x onerror=y>"


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
    return report_html(path, collect_report_data(path, keep_poses=truth is not None), truth)


def event_texts(data: ReportData) -> list[tuple[str, str]]:
    return [(event.source, event.text) for event in data.events.in_order()]


def assert_harmless(page: Page) -> None:
    """Assert that nothing in the page is executed or fetched."""
    names = {tag for tag, _ in page.tags}
    assert len(page.scripts) == 1 and page.scripts[0] == chart_script(), "omnid's own, which the policy allows"
    assert not names & {"iframe", "object", "embed", "link", "base", "form", "foreignobject"}
    for tag, attributes in page.tags:
        assert not any(name.startswith("on") for name in attributes), (tag, attributes)
        for name in ("src", "href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/png;base64,", "data:image/jpeg;base64,"))


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
    assert "darker" not in out.read_text("utf-8"), "wrong on a dark screen"
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
        "no settings are attached".capitalize(),
    ):
        assert words in page.text, words
    assert any(tag == "image" for tag, _ in page.tags)  # the map
    assert "://" not in out.read_text("utf-8")


def test_reports_gaps_resets_and_lost_cameras(tmp_path: Path) -> None:
    camera = camera_name("upper")
    entries = [
        *run(100, missing=range(30, 50)),
        state(60, "tracking", resets=1),
        status(
            61,
            DiagnosticStatus(camera, 0, "streaming", {"drops": "3"}),
            DiagnosticStatus(WHEELS, 0, "driving", {}),
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
    ]
    data = collect_report_data(save(tmp_path / "log.mcap", entries))
    assert event_texts(data) == [
        ("poses", "none for 2.10 s"),
        ("state", "odometry was reset, with an unknown gap"),
        ("upper camera", "lost since 1.0 s"),
        ("wheels", "the pose is lost"),
        ("wheels", "stopped, the pose is lost"),
        ("upper camera", "images dropped"),
        ("wheels", "driving"),
    ]
    assert data.statuses.resets == 1
    page = Page(report_html(tmp_path / "log.mcap", data))
    assert "images dropped (5)" in page.text and "upper camera" in page.text


def test_shows_stages_and_latencies(tmp_path: Path) -> None:
    def second(k: int) -> tuple[DiagnosticStatus, ...]:
        odometry = {
            "inliers": str(200 + k),
            "tracked": "300",
            "capture_to_pose_p50_ms": "81.25",
            "rate_hz": "9.5",
            "capture_to_pose_p99_ms": "163.00",
        }
        stereo = {
            "processed": str(10 * k),
            "dropped": str(k),
            "work_p50_ms": "31.5",
            "work_p99_ms": "44.0",
            "work_max_ms": "52.1",
        }
        return DiagnosticStatus(ODOMETRY, 0, "tracking", odometry), DiagnosticStatus(
            stage_name("stereo"), 0, "", stereo
        )

    entries = [*run(100), *(status(10 * k, *second(k)) for k in range(10))]
    text = Page(html_of(save(tmp_path / "log.mcap", entries))).text
    for words in (
        "81.2 / 163 ms",
        "stereo",
        "31.5",
        "52.1",
        "stereo, dropped",
        "inliers of the pose",
        "messages dropped (9)",
    ):
        assert words in text, words
    assert "no status of the daemon" not in text


def test_names_the_missing_parts_of_a_foreign_log(tmp_path: Path) -> None:
    entries = [odom(k, topic="/wheels/odometry", sigma_m=0.0) for k in range(30)]
    text = Page(html_of(save(tmp_path / "log.mcap", entries))).text
    for words in (
        "Run of wheels",
        "does not hold the state",
        "they were not set",
        "no numbers of landmarks",
        "no status of the daemon",
        "holds no images",
        "no rig.toml is attached",
        "holds no map",
        "holds no commands",
    ):
        assert words in text, words


def test_compares_with_the_truth_as_eval_does(tmp_path: Path) -> None:
    """The rig is displaced and rotated on its base, and the truth has another world frame."""
    rig = attached_rig_of_sample()
    T_base_rig, T_world_odom = se3.exp([0.3, -0.1, 0.5, 0.1, 0.2, 1.0]), se3.exp([5, -3, 1, 0, 0, 2.0])
    text = rig_toml(Rig(rig.lower, rig.upper, T_base_rig, rig.topics)).encode()
    log = save(tmp_path / "log.mcap", run(100), {"rig.toml": text})
    drift = [se3.exp([0.001 * k, 0, 0, 0, 0, 0.0005 * k]) for k in range(100)]
    T_odom_rig = np.array([se3.inverse(T_base_rig) @ T_odom_base(k) @ T_base_rig for k in range(100)])
    truth = Trajectory(np.array([at(k) for k in range(100)]), T_world_odom @ T_odom_rig @ np.array(drift))
    data = collect_report_data(log, keep_poses=True)
    found = compare_with_truth(data.poses, data.T_base_rig, truth)
    expected = evaluate(Trajectory(truth.stamps_ns, T_odom_rig), truth)
    assert found.metrics.ate_rmse_m == pytest.approx(expected.ate_rmse_m, rel=1e-6)
    assert found.position_m.highest == pytest.approx(expected.ate_max_m, rel=1e-6)
    assert found.heading_rad.newest == pytest.approx(expected.heading_end_rad, rel=1e-6)
    assert found.path[0] == pytest.approx((0, 0), abs=1e-9)
    assert found.path[-1] == pytest.approx(T_odom_base(99)[:2, 3], abs=0.2)
    assert "Against the truth" in Page(report_html(log, data, truth)).text


def attached_rig_of_sample() -> Rig:
    reader = LogReader(SAMPLE / "log.mcap")
    rig = attached_rig(reader, SAMPLE / "log.mcap")
    reader.close()
    return rig


def test_a_log_of_images_is_refused_with_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = SAMPLE / "log.mcap"
    assert main(["report", str(log), "-o", str(tmp_path / "out.html")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"omnid replay {log} --record out.mcap" in error
    assert not (tmp_path / "out.html").exists()


def test_shows_a_panorama_of_a_log_with_images(tmp_path: Path) -> None:
    """The log holds the sample's first images, and poses."""
    entries = run(20)
    with (SAMPLE / "log.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if message.log_time > at(19):
                break
            entries.append((message.log_time, channel.topic, schema.name, message.data))
    log = save(tmp_path / "log.mcap", entries, {"rig.toml": rig_toml(attached_rig_of_sample()).encode()})
    page = Page(html_of(log))
    assert [tag for tag, _ in page.tags].count("img") == 1 and "panorama at the first pose" in page.text


def test_a_hostile_log_is_shown_as_text(tmp_path: Path) -> None:
    stage = {"processed": EVIL, "dropped": EVIL, "work_p50_ms": EVIL}
    odometry = {"state": EVIL, "resets": EVIL, "inliers": EVIL, "capture_to_pose_p50_ms": EVIL}
    parts = (
        DiagnosticStatus(EVIL, 2, EVIL, {EVIL: EVIL, "drops": "1"}),
        DiagnosticStatus(stage_name(EVIL), 1, EVIL, stage),
        DiagnosticStatus(SUMMARY, 0, EVIL, {EVIL: EVIL}),
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
    assert "<b>x" not in html and html.count("<script") == 1 and "<b>log" not in html
    assert page.text.count(EVIL) > 5
    assert page.text.count("rig.toml: <img src=x") == 2  # in a remark and in a warning


def test_a_very_large_log_gives_a_small_page(tmp_path: Path) -> None:
    rng = random.Random(1)
    entries = []
    for k in range(3000):
        T = se3.exp([rng.uniform(-9, 9), rng.uniform(-9, 9), 0, 0, 0, rng.uniform(-3, 3)])
        entries.append(odom(k, T, sigma_m=rng.uniform(0.001, 10), speed_mps=rng.uniform(-5, 5)))
        entries.append(state(k, rng.choice(("tracking", "degraded", "lost")), resets=k))
        if k % 30 == 0:
            values = {f"stopped, {rng.randrange(10**6)}" * 20: str(k) for _ in range(70)}
            entries.append(
                status(
                    k,
                    *(
                        DiagnosticStatus(f"part {n}", 1, f"{'x' * 300}{rng.choice('abc')}", values)
                        for n in range(k, k + 9)
                    ),
                )
            )
    entries.append(cloud(2999, np.random.default_rng(1).uniform(-9, 9, (200_000, 3))))
    data = collect_report_data(save(tmp_path / "log.mcap", entries))
    html = report_html(tmp_path / "log.mcap", data)
    assert len(html) < 3_000_000
    assert len(data.events.in_order()) <= 32 * 40 and data.events.left_out["others"] > 100
    assert re.search(r"and \d+ more: ", Page(html).text)


@pytest.mark.parametrize("seed", range(8))
def test_any_bytes_give_a_page_or_one_error_line(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    points = np.random.default_rng(seed).uniform(-2, 3, (50, 3))
    entries = [*run(40, lost=range(9, 12)), drive(3, 0.4), cloud(39, points)]
    damaged = []
    for stamp_ns, topic, schema, payload in entries:
        data = bytearray(payload)
        for _ in range(rng.randrange(4)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        kept = rng.choice((len(data), len(data), rng.randrange(len(data))))
        damaged.append((stamp_ns, topic, schema, bytes(data[:kept])))
    log = save(tmp_path / "log.mcap", damaged)
    whole = bytearray(log.read_bytes())
    if seed % 2:
        for _ in range(20):
            whole[rng.randrange(len(whole))] = rng.randrange(256)
        log.write_bytes(whole[: rng.randrange(len(whole) // 2, len(whole))])
    try:
        assert_harmless(Page(html_of(log)))
    except OmnidError as error:
        assert "\n" not in str(error)


def test_leaves_invalid_poses_out_and_counts_them(tmp_path: Path) -> None:
    far, early = np.eye(4), np.eye(4)
    far[0, 3] = 1e12
    stray = (at(10), "/omnid/odom", "nav_msgs/msg/Odometry", odom(10**6)[3])
    entries = [*run(10), (at(10), *odom(10, far)[1:]), stray, (at(11), *odom(5, early)[1:]), odom(12)]
    data = collect_report_data(save(tmp_path / "log.mcap", entries))
    assert (data.poses.poses, data.poses.out_of_range, data.unreadable, data.poses.late) == (11, 1, 1, 1)
    text = Page(report_html(tmp_path / "log.mcap", data)).text
    assert "2 messages were left out" in text and "1 poses were left out" in text


def test_a_single_pose_gives_a_report(tmp_path: Path) -> None:
    assert "0.0 s" in Page(html_of(save(tmp_path / "log.mcap", [odom(0)]))).text


def test_refuses_a_truth_of_another_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, truth = save(tmp_path / "log.mcap", run(9)), tmp_path / "truth.txt"
    truth.write_text("\n".join(tum_row(k * 10**9, np.eye(4)) for k in range(5)))
    assert main(["report", str(log), "--truth", str(truth), "-o", str(tmp_path / "out.html")]) == 2
    assert "do both use the same clock" in capsys.readouterr().err
    assert read_tum(truth).stamps_ns.size == 5


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A log whose topic, frames, states, file name, attachments and settings hold sequences that control a terminal."""
    entries = [odom(k, topic=f"/{TERMINAL}/odom") for k in range(5)]
    entries += [
        status(2, DiagnosticStatus(ODOMETRY, 2, TERMINAL, {TERMINAL: TERMINAL})),
        status(3, DiagnosticStatus(TERMINAL, 1, f"{TERMINAL} again", {})),
    ]
    attachments = {f"{TERMINAL}.txt": b"", "omnid.toml": b'"\\u001b]0;x\\u0007" = "\\u009b31m"', "rig.toml": b"a = 1"}
    return save(tmp_path / f"{TERMINAL}.mcap", entries, attachments)


def test_prints_no_control_characters_of_a_log(hostile: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = hostile.with_name("page.html")
    main(["report", str(hostile), "-o", str(page)])
    main(["log", "info", str(hostile)])
    main(["log", "info", str(hostile.with_name(f"{TERMINAL}.none"))])
    main(["report", str(hostile), "--topic", TERMINAL, "-o", str(page)])
    shown = "".join((*capsys.readouterr(), page.read_text("utf-8")))
    assert "poses of" in shown and "odom" in shown
    assert not set(shown) & {chr(code) for code in (*range(9), *range(11, 32), *range(127, 160))}


def test_the_page_may_load_nothing_and_run_its_own_script_only(tmp_path: Path) -> None:
    page = html_of(save(tmp_path / "run.mcap", run()))
    head = page[: page.index("<title>")]
    (script,) = Page(page).scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{digest}'"
    assert f"http-equiv='Content-Security-Policy' content=\"{policy}\"" in head


def test_settings_of_many_dotted_keys_are_not_parsed(tmp_path: Path) -> None:
    settings = ("a." * 20_000 + "a = 1").encode()
    log = save(tmp_path / "run.mcap", run(), {"omnid.toml": settings})
    assert "The attached settings cannot be read." in html_of(log)


def test_the_path_in_the_map_is_drawn_beside_that_of_odometry_and_its_correction_over_time(tmp_path: Path) -> None:
    moved = se3.exp([0.3, 0.4, 0, 0, 0, 0.1])
    poses = [entry for k in range(60) for entry in (odom(k), map_pose(k, np.eye(4) if k < 30 else moved))]
    places = status(59, DiagnosticStatus(PLACES, 0, "localized", {"keyframes": "12", "loops": "3"}))
    data = collect_report_data(save(tmp_path / "a.mcap", [*poses, places]))
    corrections = data.map_poses.moved_m.points()
    assert corrections[0][1] == pytest.approx(0, abs=1e-9) and 0.3 < corrections[-1][1] < 0.7
    assert data.map_poses.turned_deg.points()[-1][1] == pytest.approx(np.degrees(0.1), abs=1e-6)
    assert data.map_poses.sigma_m.points()[-1][1] == pytest.approx(np.sqrt(3e-4))
    page = Page(report_html(tmp_path / "a.mcap", data))
    assert "In the map" in page.text and "in the map" in page.text and "keyframes12" in page.text.replace("\n", "")
    assert sum(attributes.get("class") == "pm" for _, attributes in page.tags) == 2  # the path and its key
    plain = report_html(tmp_path / "b.mcap", collect_report_data(save(tmp_path / "b.mcap", run())))
    assert "In the map" not in plain and "class='pm'" not in plain
