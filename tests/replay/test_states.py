"""What the daemon says about itself when its eyes fail: on logs of a rendered run with silence and darkness in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from calib import se3
from omnid.formats.tum import Trajectory, read_tum
from omnid.transport.codec import OdometryRecord, odometry_from_cdr
from tests.conftest import PAIRS
from tests.drivers.logs.mcap_logs import STORE
from tests.replay.command import Command, rows
from tests.replay.edited import dark, images, save

NIGHT = 20  # pairs, 2 s


def recorded(path: Path) -> list[OdometryRecord]:
    with path.open("rb") as file:
        return [odometry_from_cdr(m.data) for _, _, m in make_reader(file).iter_messages(["/omnid/odom"])]


def states(path: Path) -> list[tuple[str, int]]:
    """State and reset counter, as often as they change."""
    found = []
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages(["/omnid/status"]):
            status = STORE.deserialize_cdr(message.data, schema.name).status[0]
            values = {pair.key: pair.value for pair in status.values}
            if status.name == "omnid: odometry":
                found.append((values["state"], int(values["resets"])))
    return found


def errors_m(estimate: Trajectory, truth: Trajectory) -> np.ndarray:
    a, b = (se3.inverse(t.T[0]) @ t.T for t in (estimate, truth))
    return np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)


def test_camera_silent_for_a_second(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = [p for p in images(scene / "log.mcap") if p.camera == "lower" or not 7 <= p.pair < 17]
    log = save(tmp_path / "log.mcap", taken)
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", "--tum", tmp_path / "est", rig=scene / "rig.toml")
    assert result.count("unpaired_lower") == 10 and result.count("pairs") == PAIRS - 10
    assert states(tmp_path / "out.mcap") == [("tracking", 0), ("degraded", 0), ("tracking", 0)]
    truth = read_tum(scene / "truth.txt")
    seen = [*range(7), *range(17, PAIRS)]
    assert errors_m(read_tum(tmp_path / "est"), Trajectory(truth.stamps_ns[seen], truth.T[seen])).max() < 0.02


def test_two_seconds_of_darkness(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = images(scene / "log.mcap")
    day, evening = [p for p in taken if p.pair < 12], [p for p in taken if p.pair == 11]
    night = [dark(p.later(1 + k)) for k in range(NIGHT) for p in evening]
    morning = [p.later(NIGHT) for p in taken if p.pair >= 12]
    log = save(tmp_path / "log.mcap", [*day, *night, *morning])
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", "--tum", tmp_path / "est", rig=scene / "rig.toml")
    assert result.code == 0 and len(rows(tmp_path / "est")) == PAIRS + NIGHT
    found = states(tmp_path / "out.mcap")
    assert ("lost", 0) in found and found[-1] == ("tracking", 0)
    deviation = np.array([np.sqrt(np.trace(r.covariance[:3, :3])) for r in recorded(tmp_path / "out.mcap")])
    assert (np.diff(deviation[13 : 11 + NIGHT]) > 0).all() and deviation[10 + NIGHT] > 10 * deviation[11]
    assert deviation[-1] < 0.02
    estimate, truth = read_tum(tmp_path / "est"), read_tum(scene / "truth.txt")
    seen = [*range(12), *range(12 + NIGHT, PAIRS + NIGHT)]
    assert errors_m(Trajectory(estimate.stamps_ns[seen], estimate.T[seen]), truth).max() < 0.02


def test_another_world_after_the_darkness(omnid: Command, tmp_path: Path, scene: Path, elsewhere: Path) -> None:
    before, after = images(scene / "log.mcap"), images(elsewhere / "log.mcap")
    night = [dark(p.later(1 + k)) for k in range(NIGHT) for p in before[:2]]
    log = save(tmp_path / "log.mcap", [*before[:2], *night, *(p.later(1 + NIGHT) for p in after)])
    omnid.replay(log, "--record", tmp_path / "out.mcap", rig=scene / "rig.toml")
    found = states(tmp_path / "out.mcap")
    assert found[-1] == ("tracking", 1)
    last = recorded(tmp_path / "out.mcap")[-1]
    assert np.sqrt(np.trace(last.covariance[:3, :3])) > 0.5  # the gap stays in the covariance
