"""The documents: links lead somewhere, commands exist, API and topics are described, images and notebook are made."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

import omnid
from omnid import cli
from omnid.config import Config
from omnid.transport.topics import COMMANDS, PUBLISHED, ros_name

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
GIF_BYTES, STILL_BYTES = 1_000_000, 60_000
PARTS = ("omnid", "drivers", "calib", "tests", "docs")
OF_THE_PAST = ("CHANGELOG.md", "decisions.md")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def documents() -> list[Path]:
    """Return the pages of the site, and the documents at the top of the project."""
    return sorted([*DOCS.rglob("*.md"), *ROOT.glob("*.md")])


def prose_and_code(text: str) -> Iterator[tuple[str, bool]]:
    """Yield each line, and True where it belongs to a block of code."""
    fenced = False
    for line in text.splitlines():
        is_fence = line.lstrip().startswith("```")
        yield line, fenced or is_fence or line.startswith("    ")
        fenced ^= is_fence


@cache
def anchors(path: Path) -> set[str]:
    """Return the anchors of the headings of a document."""
    heads = [
        re.sub(r"[`*]", "", line.lstrip("# "))
        for line, is_code in prose_and_code(path.read_text("utf-8"))
        if not is_code and line.startswith("#")
    ]
    return {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}


def commands(*, in_blocks: bool) -> Iterator[tuple[str, str]]:
    """Yield the document and the words, after `omnid`, of each command in blocks of code, or between the others."""
    for path in documents():
        for line, is_code in prose_and_code(path.read_text("utf-8")):
            if is_code == in_blocks and (is_code or path.name not in OF_THE_PAST):
                for text in [line.strip()] if is_code else re.findall("`([^`]*)`", line):
                    for found in re.findall(r"(?:^|bin/|sudo |&& )omnid ([a-z][^&#|]*)", text):
                        yield path.name, found


def complaint(command: str) -> str:
    """Return what the command line reports about words that it does not accept; empty if it accepts all."""
    words = shlex.split(re.sub(r"\[(-[^]]*)\]", r"\1", command.replace("...", "")))
    with contextlib.redirect_stderr(io.StringIO()) as reported, contextlib.suppress(SystemExit):
        cli.parser_of(words).parse_args(words)
    return reported.getvalue()


@pytest.mark.parametrize("path", documents(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(path: Path) -> None:
    lost = []
    for line, is_code in prose_and_code(path.read_text("utf-8")):
        for target in [] if is_code else LINK.findall(re.sub(r"`[^`]*`", "", line)):
            name, _, anchor = target.partition("#")
            aim = path if not name else path.parent / name
            if "://" not in target and not (aim.exists() and (not anchor or anchor in anchors(aim))):
                lost.append(target)
    assert lost == []


def test_files_that_documents_name_exist() -> None:
    files = [f"/{path.relative_to(ROOT).as_posix()}" for part in PARTS for path in (ROOT / part).rglob("*.py")]
    named = [
        (path.name, name)
        for path in documents()
        if path.name not in OF_THE_PAST
        for name in re.findall(r"`([\w/]+\.py)`", path.read_text("utf-8"))
    ]
    assert len(named) > 100
    assert [entry for entry in named if not any(file.endswith(f"/{entry[1]}") for file in files)] == []


def test_commands_in_documents_are_accepted() -> None:
    found = list(commands(in_blocks=True))
    assert len(found) > 50
    assert [(document, wrong) for document, words in found if (wrong := complaint(words))] == []


def test_commands_in_the_text_lack_no_more_than_their_arguments() -> None:
    """A text names commands without their arguments, or with words such as X in place of numbers."""
    found = list(commands(in_blocks=False))
    lacks = re.compile(r"are required: |expected one argument|found '[A-Z]+'")
    assert len(found) > 80
    assert [
        (document, wrong) for document, words in found if (wrong := complaint(words)) and not lacks.search(wrong)
    ] == []


def test_programs_in_documents_exist_with_their_options() -> None:
    found = 0
    for path in documents():
        for name, words in re.findall(
            r"python -m ((?:tests|omnid)(?:\.[a-z_]+)+)\b(?!\.)([^`#\n]*)", path.read_text("utf-8")
        ):
            program = ROOT.joinpath(*name.split("."))
            assert program.with_suffix(".py").exists() or (program / "__main__.py").exists(), (path.name, name)
            # An option is a parameter, of the program or of what benchmarks share.
            text = "".join(
                file.read_text("utf-8") for place in (program, program.parent) for file in place.glob("*.py")
            )
            assert all(option in text for option in re.findall("--([a-z]+)", words)), (path.name, name, words)
            found += 1
    assert found > 10


def test_each_page_is_in_the_navigation_once() -> None:
    def leaves(entry: object) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        else:
            for inner in entry.values() if isinstance(entry, dict) else entry:  # type: ignore[attr-defined]
                yield from leaves(inner)

    shown = list(leaves(YAML(typ="safe").load(ROOT / "mkdocs.yml")["nav"]))
    assert sorted(shown) == sorted({path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")})


def test_the_public_api_is_on_its_page() -> None:
    shown = set(re.findall(r"^::: [\w.]*?(\w+)$", (DOCS / "api.md").read_text("utf-8"), re.MULTILINE))
    assert set(omnid.__all__) - {"__version__"} <= shown


def test_images_are_small() -> None:
    for path in (DOCS / "images").iterdir():
        assert path.stat().st_size < (GIF_BYTES if path.suffix == ".gif" else STILL_BYTES), path.name


def test_nav2_uses_topics_that_exist() -> None:
    folder = DOCS / "ros2"
    text = "".join((folder / name).read_text("utf-8") for name in ("nav2.launch.py", "nav2_params.yaml"))
    known = {ros_name("omnid", name) for name in (*PUBLISHED, *COMMANDS)}
    used = set(re.findall(r"/omnid/[\w/]+", text))
    assert {"/omnid/scan", "/omnid/map", "/omnid/odom", "/omnid/cmd/planner/twist"} <= used <= known
    compile((folder / "nav2.launch.py").read_text("utf-8"), "nav2.launch.py", "exec")
    parameters = YAML(typ="safe").load(folder / "nav2_params.yaml")
    assert not re.search(r": [&*]\w", text), "ROS 2 reads no anchors of YAML"
    base = Config().controller.collision
    outline = f"[[{base.front_m}, {base.half_width_m}]"
    for name in ("local_costmap", "global_costmap"):
        costmap = parameters[name][name]["ros__parameters"]
        scan = costmap["obstacle_layer"]["scan"]
        assert costmap["footprint"].startswith(outline)
        # A scan is at the height 0, give or take the tilt of the base: nav2's default range of heights is 0 to 0.
        assert scan["min_obstacle_height"] < 0 < scan["max_obstacle_height"]
        assert costmap["obstacle_layer"]["min_obstacle_height"] < 0
    assert parameters["controller_server"]["ros__parameters"]["enable_stamped_cmd_vel"] is False


NOTEBOOK = ROOT / "omnid" / "examples" / "first_replay.ipynb"


def test_the_cells_of_the_notebook_run(monkeypatch: pytest.MonkeyPatch) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    names: dict[str, Any] = {}
    for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    names["plt"].close("all")
    assert names["errors"].ate_rmse_m < 0.01  # of 4.8 m; `omnid demo` prints 1 mm
    assert names["errors"].pairs == 97


def test_the_wiring_beside_the_figure_is_that_of_the_code() -> None:
    shown = re.findall(r"^.*graph\.(?:stage|sink)\(.*$", (ROOT / "ARCHITECTURE.md").read_text("utf-8"), re.MULTILINE)
    wiring = [line.strip() for line in (ROOT / "omnid/runs/wiring.py").read_text("utf-8").splitlines()]
    assert len(shown) > 5 and set(shown) <= set(wiring), set(shown) - set(wiring)
