"""Figures of the modules."""

from __future__ import annotations

from pathlib import Path

from tests.documents.modules import drawn, modules, untested


def test_a_module_needs_a_test_file_of_its_name_in_the_folder_that_mirrors_its_own(tmp_path: Path) -> None:
    for name in ("calib/a.py", "drivers/x/b.py", "drivers/x/c.py", "omnid/__init__.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("", "utf-8")
    for name in ("tests/calib/test_a.py", "tests/drivers/test_b.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("", "utf-8")
    assert [path.as_posix() for path in modules(tmp_path)] == ["calib/a.py", "drivers/x/b.py", "drivers/x/c.py"]
    assert [path.as_posix() for path in untested(tmp_path)] == ["drivers/x/b.py", "drivers/x/c.py"]


def test_a_seed_draws_the_same_modules_again() -> None:
    found = [Path(f"{number}.py") for number in range(100)]
    assert drawn(found, 26) == drawn(found, 26) != drawn(found, 27)
    assert len(set(drawn(found, 26))) == 25
    assert drawn(found[:3], 26) != [] and len(drawn(found[:3], 26)) == 3
