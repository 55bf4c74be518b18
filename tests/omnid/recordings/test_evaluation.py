"""Metrics of known errors, and compared with the program evo on the same files."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from drivers.logs.mcap_writer import LogWriter
from omnid.cli import main
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory, read_tum, tum_row
from omnid.recordings.evaluation import evaluate
from omnid.transport import codec

STEP_NS = 100_000_000


def trajectory(stamps_ns: np.ndarray | list[int], T: np.ndarray) -> Trajectory:
    return Trajectory(np.asarray(stamps_ns, dtype=np.int64), T)


def spline(count: int = 80) -> Trajectory:
    """Return a curved path with some roll and pitch, anywhere in the world."""
    s = np.linspace(0.0, 4.0, count)
    turn = np.stack([0.05 * np.sin(3 * s), 0.04 * np.cos(2 * s), 0.4 + 0.8 * np.sin(s)], axis=1)
    t = np.stack([3 + 2 * s, np.sin(s) - 7, 1.2 + 0.02 * s], axis=1)
    stamps_ns = 1_700_000_000_000_000_000 + STEP_NS * np.arange(count)
    return trajectory(stamps_ns, se3.transform(se3.rotation_exp(turn), t))


def drifted(truth: Trajectory, step_sigma: float = 0.01) -> Trajectory:
    """Return the truth relative to its first pose, with accumulated errors and shifted stamps."""
    rng = np.random.default_rng(7)
    steps = se3.inverse(truth.T[:-1]) @ truth.T[1:]
    steps = steps @ se3.exp(rng.normal(0.0, step_sigma, (len(steps), 6)))
    T = [np.eye(4)]
    for step in steps:
        T.append(T[-1] @ step)
    return trajectory(truth.stamps_ns + rng.integers(-3_000_000, 3_000_000, len(T)), np.array(T))


def straight(count: int, step_m: float, heading_rad: float = 0.0) -> Trajectory:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = step_m * np.arange(count)
    T[1:, :3, :3] = se3.rotation_exp([0.0, 0.0, heading_rad])
    return trajectory(STEP_NS * np.arange(count), T)


def test_truth_in_another_world_is_no_error() -> None:
    truth = spline()
    moved = trajectory(truth.stamps_ns, se3.exp([4.0, -2.0, 1.0, 0.3, -0.2, 2.5]) @ truth.T)
    metrics = evaluate(moved, truth)
    assert (metrics.pairs, metrics.coverage) == (80, 1.0)
    assert metrics.length_estimate_m == pytest.approx(metrics.length_truth_m)
    errors = [metrics.ate_rmse_m, metrics.ate_max_m, metrics.end_error_m, metrics.heading_max_rad]
    errors += [metrics.rpe_translation_rmse_m, metrics.rpe_rotation_rmse_rad, metrics.length_error_ratio]
    np.testing.assert_allclose(errors, 0.0, atol=1e-7)


def test_known_errors_are_measured() -> None:
    metrics = evaluate(straight(11, 0.099, heading_rad=-0.02), straight(11, 0.1))
    assert metrics.length_truth_m == pytest.approx(1.0)
    assert metrics.length_error_ratio == pytest.approx(-0.01)
    assert metrics.end_error_m == metrics.ate_max_m == pytest.approx(0.01)
    assert metrics.ate_rmse_m == pytest.approx(0.001 * math.sqrt(np.mean(np.arange(11) ** 2)))
    assert metrics.heading_end_rad == pytest.approx(-0.02)
    assert metrics.heading_max_rad == pytest.approx(0.02)
    assert metrics.heading_rmse_rad == pytest.approx(0.02 * math.sqrt(10 / 11))
    assert metrics.rpe_rotation_rmse_rad == pytest.approx(0.02 / math.sqrt(10))
    assert max(map(len, str(metrics).splitlines())) <= 60, "as wide as a small terminal"
    for part in ("11 (100.0% of the truth)", "0.9900 m, truth 1.0000 m (-1.00 %)", "end 10.00 mm", "end -1.146 deg"):
        assert part in str(metrics)


def test_refusals_say_what_was_found() -> None:
    truth = straight(5, 0.1)
    for tolerance_s in (-0.1, math.nan, math.inf):
        with pytest.raises(OmnidError, match="tolerance"):
            evaluate(truth, truth, tolerance_s)
    with pytest.raises(OmnidError, match=r"an alignment origin or rigid .* 'sim3'"):
        evaluate(truth, truth, alignment="sim3")
    late = trajectory(truth.stamps_ns + 10**12, truth.T)
    with pytest.raises(OmnidError, match=r"0 found: estimate spans 1000.000 to 1000.400 s, truth spans 0.000 to 0.400"):
        evaluate(late, truth)
    with pytest.raises(OmnidError, match="1 found"):
        evaluate(trajectory(truth.stamps_ns[:1], truth.T[:1]), truth)
    with pytest.raises(OmnidError, match="estimate holds no pose"):
        evaluate(trajectory([], np.empty((0, 4, 4))), truth)


def test_all_positions_are_aligned_where_that_is_asked_for() -> None:
    truth = spline()
    motion = se3.exp([4.0, -2.0, 1.0, 0.3, -0.2, 2.5])
    first_is_wrong = trajectory(truth.stamps_ns, motion @ truth.T)
    first_is_wrong.T[0, :3, 3] += 0.5
    assert evaluate(first_is_wrong, truth).ate_max_m > 0.4
    rigid = evaluate(first_is_wrong, truth, alignment="rigid")
    assert rigid.ate_rmse_m < 0.15 and rigid.end_error_m < 0.05
    with pytest.raises(OmnidError, match="lie on a line"):
        evaluate(straight(11, 0.1), straight(11, 0.1), alignment="rigid")


@pytest.mark.skipif(shutil.which("evo_ape") is None, reason="evo is not on PATH: pipx install evo==1.38.1")
def test_the_errors_equal_those_of_evo(tmp_path: Path) -> None:
    truth = spline()
    files = [write(tmp_path / "truth.txt", truth), write(tmp_path / "estimate.txt", drifted(truth))]
    metrics = evaluate(read_tum(files[1]), read_tum(files[0]))
    assert metrics.pairs == 80 and metrics.ate_rmse_m > 0.05  # there is something to compare
    ape = evo("evo_ape", *files, "--align_origin")
    assert metrics.ate_rmse_m == pytest.approx(ape["rmse"], abs=1e-6)
    assert metrics.ate_max_m == pytest.approx(ape["max"], abs=1e-6)
    found = evaluate(read_tum(files[1]), read_tum(files[0]), alignment="rigid")
    assert found.ate_rmse_m == pytest.approx(evo("evo_ape", *files, "--align")["rmse"], abs=1e-6)
    rpe = evo("evo_rpe", *files, "-d", "1", "-u", "f")
    assert metrics.rpe_translation_rmse_m == pytest.approx(rpe["rmse"], abs=1e-6)
    turned = evo("evo_rpe", *files, "-d", "1", "-u", "f", "-r", "angle_deg")
    assert math.degrees(metrics.rpe_rotation_rmse_rad) == pytest.approx(turned["rmse"], abs=1e-6)


def write(path: Path, poses: Trajectory) -> str:
    rows = [tum_row(stamp_ns, T) for stamp_ns, T in zip(poses.stamps_ns, poses.T, strict=True)]
    path.write_text("\n".join(rows) + "\n")
    return str(path)


def evo(program: str, truth: str, estimate: str, *options: str) -> dict[str, float]:
    run = subprocess.run([program, "tum", truth, estimate, *options], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    return {name: float(value) for name, value in re.findall(r"^\s*(rmse|max)\s+(\S+)$", run.stdout, re.MULTILINE)}


# `omnid eval --frame auto`: a truth of a body whose axes are turned


@pytest.mark.parametrize("turned", [[0.0, 0.0, 1.6], [1.2092, -1.2092, 1.2092]])
def test_the_axes_of_another_body_are_fitted(
    turned: list[float], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = spline()
    estimate = drifted(poses, 0.001)
    est = write(tmp_path / "est.txt", estimate)
    true = write(tmp_path / "truth.txt", trajectory(poses.stamps_ns, poses.T @ se3.exp([0.0, 0.0, 0.0, *turned])))
    assert main(["eval", est, true, "--frame", "auto", "--align", "rigid", "--json"]) == 0
    found, known = json.loads(capsys.readouterr().out), evaluate(estimate, poses, alignment="rigid")
    np.testing.assert_allclose(found["turned_deg"], np.rad2deg(turned), atol=1.0)
    assert found["ate_rmse_m"] == pytest.approx(known.ate_rmse_m) and found["heading_rmse_rad"] < 0.02
    assert main(["eval", est, true, "--frame", "auto"]) == 0
    assert "fitted, so the errors are optimistic" in capsys.readouterr().out
    assert main(["eval", est, true]) == 0
    assert "try `omnid eval --frame auto`" in capsys.readouterr().out


# Which topic of a recording holds the poses


START_NS = 1_700_000_000 * 10**9
REFUSED = ""
CASES = {  # name: (topics of the log, --topic, chosen topic or REFUSED)
    "one": (("/omnid/odom",), None, "/omnid/odom"),
    "own name preferred": (("/odometry/filtered", "/omnid/odom"), None, "/omnid/odom"),
    "several of other names": (("/a/pose", "/b/pose"), None, REFUSED),
    "several of the own name": (("/omnid/odom", "/rover/odom"), None, REFUSED),
    "named": (("/a/pose", "/b/pose"), "/b/pose", "/b/pose"),
    "named but absent": (("/omnid/odom",), "/c", REFUSED),
    "none": ((), None, REFUSED),
}


def recording(path: Path, topics: tuple[str, ...]) -> Path:
    """Write three poses on each topic; those of the n-th topic are at x = n."""
    zero = np.zeros((6, 6))
    with closing(LogWriter(path, {})) as log:
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
