"""`omnid calibrate import`: files, printed line, errors before files are written."""

from __future__ import annotations

from pathlib import Path

import pytest

from calib import se3
from calib.rig_file import read_rig
from omnid.cli import main
from tests.calib.test_importers import BOTH, NAMED, T_UPPER_LOWER, chain
from tests.calib.test_importers import TEXT as OCAM


def omnid(*words: object) -> int:
    return main(["calibrate", "import", *map(str, words)])


@pytest.fixture
def kalibr(tmp_path: Path) -> Path:
    """A camchain.yaml."""
    (tmp_path / "k.yaml").write_text(chain(BOTH, T_UPPER_LOWER, NAMED))
    return tmp_path / "k.yaml"


def test_imports_kalibr_files(kalibr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert omnid(kalibr, "-o", tmp_path / "rig.toml") == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert "lower omni 768x770 (/lower/image_raw), upper omni 768x770" in line
    assert "baseline 201.2 mm, upper rotated by 17.4" in line and "no height of the cameras (--height-m" in line
    assert omnid(kalibr, "--lower", "cam1", "-o", tmp_path / "swapped.toml", "--height-m", 0.8) == 0
    swapped = read_rig(tmp_path / "swapped.toml")
    assert swapped.topics == NAMED[::-1] and swapped.height_m() == pytest.approx(0.8)
    for wrong in ("0", "nan"):
        with pytest.raises(SystemExit):
            omnid(kalibr, "-o", tmp_path / "rig.toml", "--height-m", wrong)
        assert "--height-m: expected 0.1 to 10" in capsys.readouterr().err


def test_imports_ocam_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.txt").write_text(OCAM)
    (tmp_path / "T.txt").write_text("\n".join(" ".join(map(str, row)) for row in se3.inverse(T_UPPER_LOWER).tolist()))
    files = ["--lower", tmp_path / "c.txt", "--upper", tmp_path / "c.txt", "-o", tmp_path / "rig.toml"]
    assert omnid(*files, "--transform", tmp_path / "T.txt") == 0
    found = read_rig(tmp_path / "rig.toml")
    assert se3.apply(found.upper.T_cam_rig @ se3.inverse(found.lower.T_cam_rig), [[0.0, 0, 0]])[0] == pytest.approx(
        T_UPPER_LOWER[:3, 3], abs=1e-11
    )
    assert omnid(*files) == 2 and "--transform FILE or --baseline METRES" in capsys.readouterr().err
    assert omnid(*files, "--baseline", 0.2, "--view", "direct") == 0
    assert "upper ocam, direct view 640x480" in (line := capsys.readouterr().out)
    assert "baseline 200.0 mm, upper rotated by 0.00 deg" in line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("none.yaml", "-o", "no/rig.toml"), "there is no folder"),
        (("k.yaml", "-o", "."), "expected a file to write, found a folder"),
        (("none.yaml", "-o", "rig.toml"), "cannot be read"),
        (("k.yaml", "-o", "k.yaml"), "that is read as well"),
        (("k.yaml", "--baseline", 0.2, "-o", "rig.toml"), "Kalibr's state them"),
        (("-o", "rig.toml"), "expected a Kalibr camchain.yaml, or two files of OCamCalib"),
        (("--equirectangular", "1920x960", "-o", "rig.toml"), "expected --baseline METRES"),
    ],
)
def test_invalid_requests_fail_before_files_are_written(
    words: tuple[object, ...],
    message: str,
    kalibr: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(kalibr.parent)
    before = sorted(kalibr.parent.iterdir())
    assert omnid(*words) == 2
    assert message in capsys.readouterr().err and sorted(kalibr.parent.iterdir()) == before


def test_a_rig_with_a_height_is_replaced_where_that_is_asked_for(
    kalibr: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "rig.toml"
    assert omnid(kalibr, "-o", rig, "--height-m", 0.8) == 0
    assert omnid(kalibr, "-o", rig) == 2
    assert "it states the height of a calibrated rig" in capsys.readouterr().err
    assert read_rig(rig).height_m() == pytest.approx(0.8)
    assert omnid(kalibr, "-o", rig, "--replace") == 0
    assert read_rig(rig).height_m() is None
    rig.write_text("no rig")
    assert omnid(kalibr, "-o", rig) == 2 and "is no rig" in capsys.readouterr().err
