"""Files below a folder are written through no link."""

from __future__ import annotations

from pathlib import Path

import pytest

from omnid.errors import OmnidError
from omnid.service.install import Installation
from tests.omnid.service.test_install import FILES
from tests.replay.command import Command


@pytest.mark.parametrize("link", ["etc", "etc/systemd", FILES[0], FILES[2]])
def test_writes_through_no_link_below_the_root(omnid: Command, tmp_path: Path, link: str) -> None:
    elsewhere, root = tmp_path / "elsewhere", tmp_path / "root"
    elsewhere.mkdir()
    (root / link).parent.mkdir(parents=True)
    (root / link).symlink_to(elsewhere / "file" if link in FILES else elsewhere)
    assert "symbolic link" in omnid.refused("install-service", "--root", root, "--yes")
    assert list(elsewhere.iterdir()) == []


def test_a_link_that_appears_later_is_not_followed(tmp_path: Path) -> None:
    steps = Installation(tmp_path / "root", Path("/srv/robot/bin/omnid")).steps()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "etc").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OmnidError, match="symbolic link"):
        steps[0].act()
    assert list((tmp_path / "elsewhere").iterdir()) == []
