"""Programs that omnid starts find its modules from any folder, and none that lie in the current one."""

from __future__ import annotations

import subprocess
from pathlib import Path

from omnid.engine.python_program import python, python_environment

ROOT = Path(__file__).parents[3]


def test_modules_of_the_current_folder_are_not_imported(tmp_path: Path) -> None:
    (tmp_path / "omnid.py").write_text("print('planted')")
    words = python("-c", "import omnid, os; print(omnid.__file__, os.environ['KEY'])")
    done = subprocess.run(
        words, cwd=tmp_path, env=python_environment(KEY="a"), capture_output=True, text=True, check=True
    )
    assert done.stdout == f"{ROOT / 'omnid' / '__init__.py'} a\n"
