"""A recording of `omnid run` with a driven simulated base."""

from __future__ import annotations

from pathlib import Path

from tests.ports import free_port
from tests.replay.live import Base, Operator, answers, command_line, patient, started
from tests.waiting import wait_until


def recorded_run(scene: Path, folder: Path, poses: int) -> Path:
    """Return a recording of at least so many poses, at half speed so that an idle machine drops no image."""
    port, base, kept = free_port(), Base(folder), folder / "kept"
    more = (
        "--pace",
        "0.5",
        *patient("record.enabled=true", "record.images_hz=0", f"record.folder={kept}", "record.free_mb=0"),
    )
    with started(command_line(scene, port, base.port, *more), port) as daemon:
        wait_until(lambda: answers(port) or not daemon.alive, "the bus")
        operator = Operator(port)
        operator.drive(0.3)
        wait_until(lambda: len(operator.poses) > poses and base.line.base.velocity_mps > 0.2, "poses and motion")
        operator.close()
        code, err = daemon.end()
    base.close()
    assert code == 0, err
    (path,) = kept.glob("*.mcap")
    return path
