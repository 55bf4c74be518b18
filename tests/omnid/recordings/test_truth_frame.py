"""`omnid eval` and a truth of another body or clock: what explains the error is said and fitted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.models.camera import Array
from omnid.cli import main
from omnid.formats.tum import tum_row

STAMPS_NS = 1_700_000_000_000_000_000 + 50_000_000 * np.arange(120)
S = np.linspace(0, 4, 120)
CAMERA = se3.transform(se3.rotation_exp([1.2092, -1.2092, 1.2092]), [0.1, 0.02, -0.05])


def drive(*, flat: bool) -> Array:
    """Return the poses (N, 4, 4) of a curved drive, hand-held or in a plane."""
    tilt = 0.0 if flat else 1.0
    turn = np.stack([tilt * 0.15 * np.sin(3 * S), tilt * 0.12 * np.cos(2 * S), 0.4 + 0.8 * np.sin(S)], axis=1)
    at_m = np.stack([3 + 2 * S, np.sin(S) - 7, tilt * (1.2 + 0.05 * np.sin(2 * S))], axis=1)
    return se3.transform(se3.rotation_exp(turn), at_m)


def estimated(T: Array) -> Array:
    """Return an estimate of poses, some millimetres off."""
    random = np.random.default_rng(1)
    noise = random.normal(0, 1, (len(T), 6)) * np.repeat([0.004, 0.001], 3)
    found = se3.inverse(T[0]) @ T @ se3.exp(noise)
    return se3.inverse(found[0]) @ found


def turned(deg: float, at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    return se3.transform(se3.rotation_exp([0, 0, np.deg2rad(deg)]), at_m)


HAND, FLAT = drive(flat=False), drive(flat=True)


@pytest.mark.parametrize(
    ("poses", "truth", "late_ns", "said", "unknowns"),
    [
        (HAND, HAND @ turned(88.6), 0, "another body than the rig, turned by 88.6 deg about z", 3),
        (HAND, HAND @ CAMERA, 0, "turned by 120.0 deg about (0.58 -0.58 0.58), at x 0.10", 6),
        (FLAT, FLAT @ turned(88.6), 0, "turned by 88.6 deg about z", 3),
        (FLAT, FLAT @ turned(180, (0.4, 0, 0.7)), 0, "(the path does not show z)", 5),
        (HAND, HAND, 350_000_000, "its stamps are 0.350 s later", 1),
        (HAND, HAND @ turned(88.6), 40_000_000, "0.040 s later, it is of another body than the rig, turned", 4),
        (HAND, HAND, 0, "", 0),
    ],
)
def test_says_what_explains_the_error_and_fits_it_where_asked(
    poses: Array,
    truth: Array,
    late_ns: int,
    said: str,
    unknowns: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    est, true = tmp_path / "est.txt", tmp_path / "truth.txt"
    est.write_text("\n".join(tum_row(int(n), T) for T, n in zip(estimated(poses), STAMPS_NS, strict=True)))
    true.write_text("\n".join(tum_row(int(n) + late_ns, T) for T, n in zip(truth, STAMPS_NS, strict=True)))
    code = main(["eval", str(est), str(true)])
    shown = capsys.readouterr()
    assert code == 0
    assert (said in shown.err and "--frame auto" in shown.err and shown.err.count("\n") == 1) if said else not shown.err
    assert main(["eval", str(est), str(true), "--frame", "auto"]) == 0
    shown = capsys.readouterr()
    assert not shown.err and said in shown.out
    assert (f"fitted to these poses: {unknowns}; the errors are optimistic" in shown.out) is bool(unknowns)
    (errors,) = [line for line in shown.out.splitlines() if line.startswith("position error")]
    assert float(errors.split("rmse")[1].split(",")[0]) < 20.0, "millimetres, of an estimate with 7 mm of noise"


def wander(seed: int) -> Array:
    """Return the poses (N, 4, 4) of a random walk."""
    steps = np.random.default_rng(seed).normal(0, 1, (len(S), 6)) * np.repeat([0.05, 0.03], 3)
    return se3.transform(se3.rotation_exp(steps[:, 3:].cumsum(axis=0)), steps[:, :3].cumsum(axis=0))


def with_jump(T: Array) -> Array:
    later = np.arange(len(T)) >= 60
    return np.where(later[:, None, None], T[60] @ se3.exp([0.3, 0.3, 0.25, 0.0, 0.02, 0.0]) @ se3.inverse(T[60]) @ T, T)


def scaled(T: Array, factor: float) -> Array:
    return se3.transform(T[:, :3, :3], factor * T[:, :3, 3])


STANDING = np.broadcast_to(np.eye(4), HAND.shape)
ALONG = se3.transform(np.eye(3), np.outer(2 * S + 0.2 * np.sin(3 * S), [1.0, 0.0, 0.0]))
TURNING = se3.transform(se3.rotation_exp(np.outer(S, [0.0, 0.0, 0.8])), np.zeros((len(S), 3)))


@pytest.mark.parametrize(
    ("estimate", "truth"),
    [
        (HAND, scaled(HAND, 0.97)),
        (with_jump(FLAT), FLAT),
        (with_jump(ALONG), ALONG),
        (wander(2), wander(3)),
        (with_jump(STANDING), STANDING),
        (TURNING, TURNING @ se3.exp(np.random.default_rng(2).normal(0, 0.02, (len(S), 6)))),
    ],
)
def test_claims_no_difference_where_none_explains_the_error(
    estimate: Array, truth: Array, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, poses in (("est.txt", estimated(estimate)), ("truth.txt", truth)):
        (tmp_path / name).write_text("\n".join(tum_row(int(n), T) for T, n in zip(poses, STAMPS_NS, strict=True)))
    assert main(["eval", str(tmp_path / "est.txt"), str(tmp_path / "truth.txt")]) == 0
    assert "--frame auto" not in capsys.readouterr().err
