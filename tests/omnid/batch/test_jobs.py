"""The logs of a batch."""

from __future__ import annotations

from pathlib import Path

import pytest

from omnid.batch.jobs import BatchOptions, find_logs, jobs
from omnid.errors import OmnidError


def test_finds_logs(tmp_path: Path) -> None:
    for name in ("a/1.mcap", "a/2.mcap", "a/notes.txt", "b/bag_0.db3", "b/bag_1.db3", "b/metadata.yaml", "c/x.bag"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (tmp_path / "a/circle").symlink_to(tmp_path)
    everything = [str(tmp_path / name) for name in ("a/1.mcap", "a/2.mcap", "b", "c/x.bag")]
    assert find_logs([str(tmp_path)]) == everything
    assert find_logs([str(tmp_path / "*/*.mcap"), str(tmp_path / "a/1.mcap")]) == everything[:2]
    assert [job.name for job in jobs(everything, tmp_path, BatchOptions())] == ["a-1", "a-2", "b", "c-x"]
    assert [job.name for job in jobs(["/x/a.mcap", "/x/a.db3"], tmp_path, BatchOptions())] == ["a", "a-2"]
    alike = ["/x/run-2.mcap", "/x/run.db3", "/x/run.mcap"]
    assert [job.name for job in jobs(alike, tmp_path, BatchOptions())] == ["run-2", "run", "run-3"]
    assert [job.name for job in jobs(alike[::-1], tmp_path, BatchOptions())] == ["run", "run-3", "run-2"]
    for missing in ("nowhere.mcap", "nowhere/*.mcap"):
        with pytest.raises(OmnidError, match="batch: no log"):
            find_logs([str(tmp_path / missing)])
