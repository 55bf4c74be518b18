"""One content in every format of logs gives the same images, pairs, poses and reports; loss ends with code 1."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from omnid.calibration.images import read_pairs
from tests.conftest import PAIRS
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, UPPER, Entry, compressed, write_bag, write_log
from tests.drivers.logs.test_formats import FORMATS
from tests.replay.command import Command
from tests.replay.edited import Image, images, save

QUICK = ("--inline", "--set", "places.enabled=false", "--set", 'motion.imu=""')


def entries(scene: Path) -> list[Entry]:
    topics = {"lower": LOWER, "upper": UPPER}
    taken = images(scene / "log.mcap")
    return [Entry(topics[i.camera], COMPRESSED, compressed(i.stamp_ns, i.jpeg), i.written_ns) for i in taken]


READ = ("mcap, zstd", "mcap, compressed messages", "db3 of a killed recorder", "bag, bz2", "folder")


def test_every_command_reads_the_same_in_every_format(omnid: Command, tmp_path: Path, scene: Path) -> None:
    logs, trajectories = [scene / "log.mcap"], set()
    for name in READ:
        folder = tmp_path / name
        folder.mkdir()
        logs.append(FORMATS[name](folder, entries(scene)))
    for log in logs:
        # 1. `log info`
        code, out, err = omnid("log", "info", log)
        assert (code, err) == (0, "") and re.search(r"state +whole", out)
        assert len(re.findall(rf" +{COMPRESSED} +{PAIRS} ", out)) == 2
        # 2. `calibrate`
        pairs = read_pairs(log)
        assert len(pairs.names) == PAIRS and not pairs.notes
        assert all(map(np.array_equal, pairs.sides[0].values(), read_pairs(scene / "log.mcap").sides[0].values()))
        # 3. `replay`
        result = omnid.replay(log, *QUICK, "--tum", tmp_path / "est.txt", rig=scene / "rig.toml")
        assert result.code == 0 and not result.err and result.count("pairs") == PAIRS
        trajectories.add((tmp_path / "est.txt").read_bytes())
    assert len(trajectories) == 1


# What happens to the images of every fourth pair.
LOSSES: dict[str, Callable[[Image], Image | None]] = {
    "an image is missing": lambda image: None if image.camera == "upper" else image,
    "an image is cut": lambda image: replace(image, jpeg=image.jpeg[:3000]) if image.camera == "lower" else image,
}


@pytest.mark.parametrize("name", LOSSES)
def test_the_exit_code_reports_loss(omnid: Command, tmp_path: Path, scene: Path, name: str) -> None:
    taken = [LOSSES[name](image) if image.pair % 4 == 1 else image for image in images(scene / "log.mcap")]
    log = save(tmp_path / "log.mcap", [image for image in taken if image is not None])
    result = omnid.replay(log, *QUICK, rig=scene / "rig.toml")
    assert result.code == 1 and "6 of 24 pairs are missing" in result.err
    assert result.err.count("6 images could not be used") == name.endswith("cut")


@pytest.mark.parametrize("kind", ["lz4", "bag"])
def test_images_in_corrupt_chunks_are_a_loss(omnid: Command, tmp_path: Path, scene: Path, kind: str) -> None:
    if kind == "bag":
        log = write_bag(tmp_path / "log.bag", entries(scene), "BZ2", chunk_bytes=30_000)
    else:
        log = write_log(tmp_path / "log.mcap", entries(scene), chunk_size=30_000, compression=CompressionType.LZ4)
    data = bytearray(log.read_bytes())
    for part in (0.2, 0.4, 0.6, 0.8):
        data[int(part * len(data))] ^= 1
    log.write_bytes(data)
    result = omnid.replay(log, *QUICK, rig=scene / "rig.toml")
    assert result.code == 1 and "skipped 4 corrupt chunks" in result.err
    assert "images may be missing" in result.err


def test_a_camera_of_half_the_rate_loses_nothing(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = [image for image in images(scene / "log.mcap") if image.camera == "lower" or image.pair % 2 == 0]
    log = save(tmp_path / "log.mcap", taken)
    result = omnid.replay(log, *QUICK, rig=scene / "rig.toml")
    assert result.code == 0 and result.count("pairs") == PAIRS // 2 and "are missing" not in result.err
