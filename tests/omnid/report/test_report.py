"""`omnid report`: the page shows what is recorded and names what is missing, and text of the log is never executed."""

from __future__ import annotations

import random
import re
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from omnid.cli import main
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory
from omnid.report.report import report_html
from omnid.report.report_data import collect_report_data
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY, PLACES, SUMMARY, stage_name
from tests.omnid.report.pages import SAMPLE, Page, assert_harmless, html_of
from tests.omnid.report.recorded_logs import (
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
EVIL = "<script>alert('x')</script>\"'&<img src=x onerror=y>"


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


def test_a_log_of_images_is_refused_with_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = SAMPLE / "log.mcap"
    assert main(["report", str(log), "-o", str(tmp_path / "out.html")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"omnid replay {log} --record out.mcap" in error
    assert not (tmp_path / "out.html").exists()


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
