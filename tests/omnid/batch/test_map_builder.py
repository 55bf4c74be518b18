"""The order in which maps are joined."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from omnid.batch.map_builder import MapResult, MapTask, build_map
from omnid.errors import OmnidError

LOGS = [Path(f"/logs/{name}") for name in ("a1", "b1", "a2", "b2", "ab", "empty")]


class Programs:
    """In place of programs: maps are the names of their logs, and share a place where they have a letter in common."""

    def __init__(self) -> None:
        self.joined, self.asked = list[list[str]](), list[tuple[str, ...]]()
        self.content: dict[str, str] = {}

    def __call__(self, tasks: Sequence[MapTask]) -> Iterator[MapResult]:
        self.joined.append([])
        for task in reversed(tasks):
            self.asked.append(task.words[1:])
            words = [self.content.get(word, Path(word).name) for word in task.words[2:]]
            if task.words[1] == "build":
                yield MapResult(task, is_empty=words[0] == "empty")
                self.content[str(task.output)] = words[0]
            elif set(words[0]) & set(words[1]) & set("ab"):
                self.content[str(task.output)] = f"{words[0]}+{words[1]}"
                self.joined[-1].append(self.content[str(task.output)])
                yield MapResult(task)
            else:
                yield MapResult(task, "it shares no place with the maps before")


def test_maps_that_share_a_place_are_joined_first_and_the_frame_is_that_of_the_first_log(tmp_path: Path) -> None:
    programs, lines = Programs(), list[str]()
    found = build_map(LOGS, ["--rig", "/rig.toml"], None, tmp_path, programs, lines.append)
    assert programs.joined == [[], [], ["b1+b2", "a1+a2"], [], ["a1+a2+ab"], ["a1+a2+ab+b1+b2"]]
    assert programs.content[str(found)] == "a1+a2+ab+b1+b2"
    assert "1/6  /logs/empty: no keyframe" in lines and any("2 + 1 logs" in line for line in lines)


def test_logs_that_share_no_place_are_named_and_each_pair_is_tried_once(tmp_path: Path) -> None:
    programs = Programs()
    with pytest.raises(OmnidError, match=r"/logs/b1: shares no place with /logs/a1 that is recognised"):
        build_map(LOGS[:4], [], None, tmp_path, programs, lambda _: None)
    pairs = [words for words in programs.asked if words[0] == "merge"]
    assert len(pairs) == len(set(pairs)) and programs.joined[-2:] == [["b1+b2", "a1+a2"], []]


def test_no_map_of_logs_without_a_keyframe_and_an_error_of_a_program_ends_it(tmp_path: Path) -> None:
    assert build_map(LOGS[-1:], [], None, tmp_path, Programs(), lambda _: None) is None
    with pytest.raises(OmnidError, match="map build: /logs/a1: it is no log"):
        build_map(
            LOGS[:1], [], None, tmp_path, lambda tasks: (task.failed("it is no log") for task in tasks), lambda _: None
        )
