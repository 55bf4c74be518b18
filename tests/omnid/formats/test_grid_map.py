"""Grids for nav2: thresholds as map_server applies them, orientation, names."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from ruamel.yaml import YAML

from omnid.core.mapping.scan_grid import FREE, OCCUPIED, UNKNOWN, Grid
from omnid.errors import OmnidError
from omnid.formats.grid_map import write_grid

CELLS = np.array([[FREE, OCCUPIED, UNKNOWN], [UNKNOWN, FREE, FREE]], np.int8)


@pytest.mark.parametrize("name", ["place.yaml", "my place: 1.yml", "it's.yaml"])
def test_map_server_reads_the_same_cells(tmp_path: Path, name: str) -> None:
    write_grid(tmp_path / name, Grid(CELLS, 0.05, (-1.5, 2.25)))
    described = YAML(typ="safe").load((tmp_path / name).read_text())
    image = cv2.imread(str(tmp_path / described["image"]), cv2.IMREAD_UNCHANGED)
    assert image is not None
    # nav2_map_server/src/map_io.cpp, mode trinary: darkness against both thresholds, first row at the top.
    darkness = (255 - image[::-1].astype(float)) / 255
    read = np.where(
        darkness > described["occupied_thresh"], OCCUPIED, np.where(darkness < described["free_thresh"], FREE, UNKNOWN)
    )
    np.testing.assert_array_equal(read, CELLS)
    assert described["resolution"] == 0.05 and described["origin"] == [-1.5, 2.25, 0.0] and described["negate"] == 0


def test_another_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OmnidError, match=r"expected a name that ends in \.yaml"):
        write_grid(tmp_path / "place.png", Grid(CELLS, 0.05, (0.0, 0.0)))


def test_a_map_that_cannot_be_written_whole_leaves_the_old_image(tmp_path: Path) -> None:
    """Its text tells where it lies."""
    (tmp_path / "place.pgm").write_bytes(b"old")
    (tmp_path / "place.yaml").mkdir()
    with pytest.raises(OmnidError, match="cannot write the map"):
        write_grid(tmp_path / "place.yaml", Grid(CELLS, 0.05, (0.0, 0.0)))
    assert (tmp_path / "place.pgm").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 2
