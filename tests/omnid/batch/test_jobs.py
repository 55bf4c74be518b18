"""The logs of a batch."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from omnid.batch.jobs import BatchOptions, find_logs, input_files, jobs
from omnid.config import PlacesConfig
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


def test_finds_logs_that_are_folders_of_images(tmp_path: Path) -> None:
    """Each camera has a folder; some tools write the images one folder deeper; one camera alone is no log."""
    for name in ("run1/lower/1.5.png", "run1/upper/1.5.png", "run2/cam0/data/1.5.png", "run2/cam1/data/1.5.png"):
        path = tmp_path / "logs" / name
        path.parent.mkdir(parents=True)
        path.touch()
    (tmp_path / "logs/run1/truth.txt").touch()
    logs = [str(tmp_path / "logs" / name) for name in ("run1", "run2")]
    assert find_logs([str(tmp_path)]) == logs == find_logs([str(tmp_path / "logs/*")])
    found = jobs(logs, tmp_path / "out", BatchOptions())
    assert [job.name for job in found] == ["run1", "run2"]
    assert [job.truth() for job in found] == [tmp_path / "logs/run1/truth.txt", None]
    with pytest.raises(OmnidError, match="or a folder of images for each camera"):
        find_logs([str(tmp_path / "logs/run1/lower")])


def names_of(out: Path, *logs: str) -> list[str]:
    return [job.name for job in jobs(logs, out, BatchOptions())]


def test_results_of_another_log_keep_their_folder(tmp_path: Path) -> None:
    def store(name: str, text: str) -> None:
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "result.json").write_text(text)

    store("run", json.dumps({"log": "/x/mon/run.mcap"}))
    assert names_of(tmp_path, "/x/mon/run.mcap") == ["run"]
    assert names_of(tmp_path, "/x/tue/run.mcap") == ["run-2"]
    store("run-2", json.dumps({"log": "/x/tue/run.mcap"}))
    assert names_of(tmp_path, "/x/tue/run.mcap") == ["run-2"], "it goes on in its own folder"
    assert names_of(tmp_path, "/x/wed/run-2.mcap", "/x/wed/run.mcap") == ["run-2-2", "run-3"]
    assert names_of(tmp_path, "/x/mon/run.db3", "/x/mon/run.mcap") == ["run-3", "run"]
    for damaged in ("", "[]", "{}", '{"log": 1}'):
        store("run", damaged)
        assert names_of(tmp_path, "/x/tue/run.mcap") == ["run"]


def test_the_key_changes_with_all_files_that_make_a_result(tmp_path: Path) -> None:
    log, truth, rig, settings, tags, places = (
        tmp_path / name for name in ("log.mcap", "truth.txt", "rig.toml", "omnid.toml", "tags.toml", "site.omap")
    )
    for path in (log, rig, settings, tags, places):
        path.write_text("a")

    def key() -> str:
        known = PlacesConfig(map=str(places), tags=str(tags), localize_only=True)
        (job,) = jobs([str(log)], tmp_path / "out", BatchOptions(inputs=input_files(rig, settings, known)))
        assert job.key() == job.key()
        return job.key()

    keys = [key()]
    for path in (log, truth, rig, settings, tags, places):
        path.write_text("changed")
        keys.append(key())
    os.utime(truth, (1, 1))
    keys.append(key())
    truth.unlink()
    keys.append(key())
    assert len(set(keys)) == len(keys)

    assert input_files(None, None, PlacesConfig()) == ()


def test_a_map_that_each_replay_would_extend_is_refused() -> None:
    with pytest.raises(OmnidError, match=r"'site.omap', which each replay would extend: add --set places.localize_on"):
        input_files(None, None, PlacesConfig(map="site.omap"))
