"""Documents beside the code as parts of pages: includes, links, lists."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.documents import site_hooks
from tests.documents.site_hooks import included, linked, pages


def test_a_page_includes_a_file_with_its_headings_one_level_down() -> None:
    line = "[included: omnid/calibration/README.md](../omnid/calibration/README.md)"
    text = included("calibrate.md", f"# Calibrate\n\n{line}\n")
    assert text.count("\n# ") == 0 and "\n## Calibration\n" in text
    assert "[included" not in text


def test_a_page_that_is_an_included_file_keeps_its_headings() -> None:
    assert included("safety.md", "[included: omnid/controller/SAFETY.md](x)\n").startswith("# Safety of the wheels\n")


def test_code_is_included_as_a_block() -> None:
    text = included("ros2.md", "# ROS 2\n[code: docs/ros2/nav2.launch.py](ros2/nav2.launch.py)\n")
    assert "```python\n" in text and "generate_launch_description" in text


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("[Safety](omnid/controller/SAFETY.md#arming)", "[Safety](safety.md#arming)"),
        ("[results](docs/RESULTS.md)", "[results](RESULTS.md)"),
        ("![plan](omnid/sample/plan.png)", "![plan](included/omnid/sample/plan.png)"),
        ("![drive](docs/images/drive.gif)", "![drive](images/drive.gif)"),
        ("[a module](omnid/api.py)", "a module"),
        ("[zenoh](https://zenoh.io)", "[zenoh](https://zenoh.io)"),
        ("see `omnid/core/README.md`", "see [`omnid/core/README.md`](method.md)"),
        ("see `docs/RESULTS.md`", "see [`docs/RESULTS.md`](RESULTS.md)"),
        ("see `omnid/api.py`", "see `omnid/api.py`"),
        ("write `[x](docs/maps.md)`", "write `[x](docs/maps.md)`"),
    ],
)
def test_links_and_paths_lead_to_pages(line: str, shown: str) -> None:
    assert linked(line, "README.md", "index.md") == shown


def test_links_start_from_the_page_and_not_from_the_file() -> None:
    assert linked("`SITE.md`, [x](../core/README.md)", "omnid/transport/SITE.md", "maps.md") == (
        "[`SITE.md`](bus.md), [x](method.md)"
    )


def test_blocks_of_code_stay_as_they_are() -> None:
    text = "```\nsee `docs/results`\n- item\n```\n\n    # no heading"
    assert linked(text, "README.md", "index.md", deeper=True) == text


def test_lists_and_tables_get_the_blank_line_that_python_markdown_needs() -> None:
    assert linked("text\n- a\n  - b\n- c\nmore\n| x |\n|---|", "README.md", "index.md") == (
        "text\n\n- a\n    - b\n- c\nmore\n\n| x |\n|---|"
    )


def test_every_included_file_exists() -> None:
    assert all((site_hooks.ROOT / source).exists() for source in pages())
    assert Path("omnid/sample/plan.png").as_posix() in site_hooks.included_images()
